"""The 3-D part: the robot, poses with their trails, chunks as ribbons, objects."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
import rerun as rr

from vla_zenoh.control.actions import Steps, chunk_poses
from vla_zenoh.control.limits import workspace_corners
from vla_zenoh.control.plan_timeline import Goal, Plan
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.plan_clock import idle_time, least_steps
from vla_zenoh.profile import KeepOut, Profile
from vla_zenoh.types import ActionChunk, FloatArray, ObjectPoses
from vla_zenoh_view import paths
from vla_zenoh_view.robot_model import RobotMeshes

TRAIL_NS = 6_000_000_000
TRAIL_PERIOD_NS = 100_000_000
TRAIL_STEP_M = 0.0005
HISTORY = 2000
"""Goals kept: some seconds of a command stream; observations are not older."""
STALE_NS = 2_000_000_000
"""Age at which a ribbon that no newer chunk of its worker replaces is removed."""
TRAIL_RADIUS_M, RIBBON_RADIUS_M, AXIS_M = 0.0018, 0.003, 0.06
OBJECT_RADIUS_M = 0.012
OBJECT_COLOURS = {
    "red": (255, 110, 100),
    "green": (110, 225, 120),
    "blue": (120, 170, 255),
    "yellow": (250, 220, 90),
}
KEEP_OUT_COLOUR = (220, 60, 60, 60)
PLANE_M = 1.0
"""Edge of the piece of a plane that is drawn."""
OTHER_OBJECT = (225, 228, 235)
REACH_M = 0.3
"""An object this far outside of the workspace is not the robot's concern."""


class PoseTrail:
    """Recent path of a pose."""

    def __init__(self, stream: rr.RecordingStream, root: str, name: str) -> None:
        self._stream, self._name, self._path = stream, name, f"{root}/{paths.TRAILS}/{name}"
        self._points: deque[tuple[int, FloatArray]] = deque()
        self._drawn_ns, self._drawn = 0, 0

    def add(self, stamp_ns: int, position_m: FloatArray) -> None:
        """Append `position_m`, and draw at intervals."""
        points = self._points
        if points and stamp_ns < points[-1][0]:  # a replay started again
            points.clear()
            self._drawn_ns = 0
        if not points or np.linalg.norm(position_m - points[-1][1]) > TRAIL_STEP_M:
            points.append((stamp_ns, position_m))
        while points and points[0][0] < stamp_ns - TRAIL_NS:
            points.popleft()
        if stamp_ns - self._drawn_ns < TRAIL_PERIOD_NS or not (points or self._drawn):
            return
        self._drawn_ns, self._drawn = stamp_ns, len(points)
        line = [point for _, point in points] if len(points) > 1 else []
        self._stream.log(
            self._path,
            rr.LineStrips3D(
                [line] if line else [], radii=TRAIL_RADIUS_M, colors=[paths.COLOURS[self._name]]
            ),
        )


def _drawn(shape: KeepOut) -> rr.Boxes3D | rr.Ellipsoids3D:
    """A keep-out; a half-space as a piece of its plane."""
    centres, colors = [shape.centre_m], [KEEP_OUT_COLOUR]
    fill = rr.components.FillMode.Solid
    if shape.radius_m is not None:
        return rr.Ellipsoids3D(
            centers=centres, half_sizes=[[shape.radius_m] * 3], colors=colors, fill_mode=fill
        )
    up = np.array([0.0, 0.0, 1.0])
    edges = shape.box_m or (PLANE_M, PLANE_M, 0.001)
    turn = pin.Quaternion(pin.AngleAxis(shape.yaw_rad, up))
    if shape.normal is not None:
        turn = pin.Quaternion.FromTwoVectors(up, np.array(shape.normal))
    return rr.Boxes3D(
        centers=centres, sizes=[edges], quaternions=[turn.coeffs()], colors=colors, fill_mode=fill
    )


class Scene:
    """Logs the 3-D view in the base frame of an arm, at the current time of a Rerun stream.

    Args:
        robot: its model; None: only poses are shown.
    """

    def __init__(
        self, stream: rr.RecordingStream, profile: Profile, robot: RobotMeshes | None
    ) -> None:
        self._stream, self._robot, self._root = stream, robot, paths.arm(profile.part)
        self._trails = {name: PoseTrail(stream, self._root, name) for name in paths.COLOURS}
        self._goals: deque[tuple[int, Pose]] = deque(maxlen=HISTORY)
        self._measured: Pose | None = None
        self._plans: dict[str, Plan] = {}
        self._ribbons: dict[str, int] = {}
        self._begin(profile)

    def _begin(self, profile: Profile) -> None:
        log = self._stream.log
        log(paths.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        low, high = workspace_corners(profile.limits)
        self._reach = low - REACH_M, high + REACH_M
        box = rr.Boxes3D(mins=[low], sizes=[high - low], colors=[(120, 130, 150, 70)], radii=0.001)
        log(f"{self._root}/workspace", box, static=True)
        for name, shape in profile.limits.reach.keep_out.items():
            log(f"{self._root}/keep_out/{name}", _drawn(shape), static=True)

    # -- robot and poses ----------------------------------------------------------------------
    def joints(self, names: Sequence[str], positions: FloatArray) -> None:
        """Move the robot to measured joint positions."""
        if self._robot is not None:
            self._robot.move(dict(zip(names, positions.tolist(), strict=True)))
            self.robot_moved()

    def gripper(self, width_m: float) -> None:
        """Set the opening of the gripper; drawn with the next joints."""
        if self._robot is not None:
            self._robot.open(width_m)

    def robot_moved(self) -> None:
        """Draw the robot at its current joints."""
        for link, pose in self._robot.placements() if self._robot is not None else ():
            self._log_pose(paths.below(f"{self._root}/{paths.ROBOT}", link), pose)

    def pose(self, name: str, stamp_ns: int, pose: Pose) -> None:
        """Draw the pose `goal`, `commanded` or `measured`."""
        self._log_pose(f"{self._root}/{paths.POSES}/{name}", pose, rr.TransformAxes3D(AXIS_M))
        self._trails[name].add(stamp_ns, pose.position_m)
        if name == paths.MEASURED:
            self._measured = pose
            for worker, drawn_ns in list(self._ribbons.items()):
                if not 0 <= stamp_ns - drawn_ns < STALE_NS:
                    del self._ribbons[worker]
                    self._stream.log(self._ribbon(worker), rr.Clear(recursive=True))

    def goal(self, stamp_ns: int, pose: Pose) -> None:
        """Keep a goal of the command stream: chunks start at the goal of their observation."""
        if self._goals and stamp_ns < self._goals[-1][0]:
            self._goals.clear()
        self._goals.append((stamp_ns, pose))

    def _log_pose(self, path: str, pose: Pose, *more: rr.TransformAxes3D) -> None:
        placed = rr.Transform3D(translation=pose.position_m, mat3x3=pose.rotation)
        self._stream.log(path, placed, *more)

    # -- chunks -------------------------------------------------------------------------------
    def chunk(
        self, stamp_ns: int, chunk: ActionChunk, action: ActionSpec, steps: Steps, obeyed: bool
    ) -> None:
        """Draw the waypoints of a chunk, from the goal in force at its observation.

        Args:
            steps: (H, D) the arm's numbers.
        """
        measured = action.anchor == "measured"
        start = self._measured if measured else self._start_of(chunk)
        if start is None or action.space == "joint":
            return  # waypoints in joints are poses only by the arm's kinematics
        goals = [Goal(pose, 0.0) for pose in chunk_poses(action, steps, start)]
        dt_ns = max(int(action.dt_s * 1e9), 1)
        before, seen_ns = self._plans.get(chunk.worker), chunk.observation_stamp_ns
        runs = [] if before is None else [(before.effective_ns, before.end_ns)]
        idle_ns = round(idle_time(seen_ns, stamp_ns, runs))
        begin = None if least_steps(action, len(goals)) else Goal(start, 0.0)
        plan = Plan(stamp_ns, seen_ns, dt_ns, goals, idle_ns=idle_ns, begin=begin)
        self._plans[chunk.worker] = plan
        self._ribbons[chunk.worker] = stamp_ns
        line = np.array([start.position_m, *(goal.pose.position_m for goal in goals)])
        colour = paths.CHUNK if obeyed else paths.SHADOW
        path = self._ribbon(chunk.worker)
        self._stream.log(path, rr.LineStrips3D([line], radii=RIBBON_RADIUS_M, colors=[colour]))
        waypoints = rr.Points3D(line[1:], radii=1.8 * RIBBON_RADIUS_M, colors=[colour])
        self._stream.log(f"{path}/steps", waypoints)

    def _ribbon(self, worker: str) -> str:
        return paths.below(f"{self._root}/{paths.CHUNKS}", worker)

    def _start_of(self, chunk: ActionChunk) -> Pose | None:
        """The goal that was in force when its observation was taken, else the measured pose.

        The command stream holds the end of the current step; its progress follows from the
        worker's previous chunk.
        """
        seen_ns = chunk.observation_stamp_ns
        goal = next((pose for stamp, pose in reversed(self._goals) if stamp <= seen_ns), None)
        if goal is None:
            return self._measured
        plan = self._plans.get(chunk.worker)
        if plan is None or not plan.start_ns <= seen_ns < plan.end_ns:
            return goal
        ends = plan.goals[plan.index_at(seen_ns)].pose.position_m
        return Pose(goal.position_m + plan.goal_at(seen_ns).pose.position_m - ends, goal.rotation)

    # -- objects ------------------------------------------------------------------------------
    def objects(self, objects: ObjectPoses) -> None:
        """Draw the simulator's objects; those that are parked away from the robot are left out."""
        low, high = self._reach
        within = (objects.position_m >= low) & (objects.position_m <= high)
        near = np.asarray(within.all(axis=1))
        names = [name for name, shown in zip(objects.names, near, strict=True) if shown]
        colours = [OBJECT_COLOURS.get(name.split("_")[0], OTHER_OBJECT) for name in names]
        points = rr.Points3D(
            objects.position_m[near],
            radii=OBJECT_RADIUS_M,
            labels=[name.removesuffix("_brick") for name in names],
            colors=colours,
        )
        self._stream.log(paths.OBJECTS, points)
