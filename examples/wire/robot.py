"""A robot in plain Python: a Panda without hardware that is where its joints are commanded to be.

    vla-zenoh up examples/wire/robot.yaml    # everything but the robot
    python examples/wire/robot.py [ENDPOINT] [ROBOT] [SILENCE_S]

It has the duties of a robot: it follows one writer, in order, and brakes by itself on a stop, and
when its commands fall silent. It limits no speed: that is the task of a real robot's controller.
"""

import math
import sys
import time
from queue import Empty, SimpleQueue

import zenoh
from plain_node import STATE, Node, OneWriter, Rejected, number, numbers, open_session, read

JOINTS = [f"panda_joint{index}" for index in range(1, 8)]
HOME_RAD = [0.0, -0.0439564754, 0.0, -2.6269994397, 0.0, 2.5830429643, 0.7853981634]
MAX_WIDTH_M = 0.08
PERIOD_S = 0.004
BRAKE_RAD_S2 = 4.0
NEAR_RAD = 0.05
"""A command is this near to where the arm stands, or it is meant for another place."""
STILL_RAD_S = 1e-3
OBEYED = ("active", "holding")
"""States of the command node in which a stream may begin."""


class Arm:
    """Joints and fingers, and what moves them: a command stream, or the arm's own brake."""

    def __init__(self, silence_s: float) -> None:
        self.position_rad, self.velocity_rad_s = list(HOME_RAD), [0.0] * 7
        self.width_m = MAX_WIDTH_M
        self.braking = self.latched = False
        self._silence_s, self._heard_s = silence_s, 0.0
        self._writer, self._gripper_writer = OneWriter(), OneWriter()

    @property
    def mode(self) -> str:
        """As in `GripperState`: "ready" when the arm follows commands."""
        return "latched" if self.latched else "braking" if self.braking else "ready"

    def follow(self, header: dict, record: dict) -> None:
        """Follow a `JointCommand`; raises `Rejected`."""
        self._writer.check(header)
        self._check_ready()
        if not self._writer.source and record.get("state") not in OBEYED:
            raise Rejected("inactive", "no stream begins while its writer brakes or stands")
        if record.get("names") != JOINTS:
            raise Rejected("names", f"the joints are {', '.join(JOINTS)}")
        position_rad = numbers(record, "position_rad", 7)
        velocity_rad_s = numbers(record, "velocity_rad_s", 7)
        away_rad = max(map(abs, map(float.__sub__, position_rad, self.position_rad)))
        if away_rad > NEAR_RAD:
            raise Rejected("jump", f"a joint is {away_rad:.3f} rad from the command")
        self._writer.accept(header)
        self._heard_s = time.monotonic()
        self.position_rad, self.velocity_rad_s = position_rad, velocity_rad_s

    def grip(self, header: dict, record: dict) -> None:
        """Obey a `GripperCommand` of the arm's writer; raises `Rejected`."""
        self._gripper_writer.source = self._writer.source
        self._gripper_writer.check(header)
        self._check_ready()
        self._gripper_writer.accept(header)
        self.width_m = min(max(number(record.get("width_m"), "width_m"), 0.0), MAX_WIDTH_M)

    def _check_ready(self) -> None:
        if self.mode != "ready":
            raise Rejected(self.mode, "the arm brakes, or is stopped")

    def stop(self) -> None:
        """Brake, and follow nothing until `reset`."""
        self.latched = True
        self._brake()

    def reset(self) -> None:
        """Follow commands again."""
        self.latched = False

    def tick(self) -> None:
        """One period: brake if the stream fell silent."""
        if self._writer.source and time.monotonic() - self._heard_s > self._silence_s:
            self._brake()
        if self.braking:
            slower = BRAKE_RAD_S2 * PERIOD_S
            for joint, speed in enumerate(self.velocity_rad_s):
                self.velocity_rad_s[joint] = math.copysign(max(abs(speed) - slower, 0.0), speed)
                self.position_rad[joint] += self.velocity_rad_s[joint] * PERIOD_S
            self.braking = any(self.velocity_rad_s)

    def _brake(self) -> None:
        self._writer.release()
        self.braking = max(map(abs, self.velocity_rad_s)) > STILL_RAD_S
        if not self.braking:
            self.velocity_rad_s = [0.0] * 7


# -- where the tool is ----------------------------------------------------------------------------
def times(a: list[float], b: list[float]) -> list[float]:
    """Product of two quaternions x, y, z, w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


def inverse(a: list[float]) -> list[float]:
    """The inverse of a unit quaternion."""
    return [-a[0], -a[1], -a[2], a[3]]


def rotate(turn: list[float], way: list[float]) -> list[float]:
    """A vector, rotated."""
    return times(times(turn, [*way, 0.0]), inverse(turn))[:3]


QUARTER = math.pi / 2
LINKS = (
    # Denavit and Hartenberg's parameters after Craig: a (m), d (m), alpha (rad), of each joint and
    # of the hand, whose tool centre point is 0.1034 m from the flange.
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -QUARTER),
    (0.0, 0.316, QUARTER),
    (0.0825, 0.0, QUARTER),
    (-0.0825, 0.384, -QUARTER),
    (0.0, 0.0, QUARTER),
    (0.088, 0.0, QUARTER),
    (0.0, 0.107 + 0.1034, 0.0),
)
HAND_RAD = -math.pi / 4


def tool(joints_rad: list[float]) -> tuple[list[float], list[float]]:
    """Position (m) and quaternion of the TCP in the base frame."""
    place, turn = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    for (a, d, alpha), angle in zip(LINKS, [*joints_rad, HAND_RAD], strict=True):
        turn = times(turn, [math.sin(alpha / 2), 0.0, 0.0, math.cos(alpha / 2)])
        place = [p + w for p, w in zip(place, rotate(turn, [a, 0.0, d]), strict=True)]
        turn = times(turn, [0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)])
    return place, turn


# -- states ---------------------------------------------------------------------------------------
class States:
    """Publishes the three states, with one stamp and number."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._before = tool(HOME_RAD)
        self._before_ns = time.time_ns()

    def publish(self, arm: Arm) -> None:
        """Publish where the arm is now."""
        now_ns = time.time_ns()
        place, turn = tool(arm.position_rad)
        joints = {
            "names": JOINTS,
            "position_rad": arm.position_rad,
            "velocity_rad_s": arm.velocity_rad_s,
            "effort_nm": None,
        }
        pose = {
            "position_m": place,
            "quat_xyzw": turn,
            "twist": self._twist(place, turn, now_ns),
        }
        gripper = {
            "width_m": arm.width_m,
            "moving": False,
            "holding": False,
            "mode": arm.mode,
        }
        self._node.publish("state/joint", joints, STATE, now_ns)
        self._node.publish("state/pose", pose, STATE, now_ns)
        self._node.publish("state/gripper", gripper, STATE, now_ns)

    def _twist(self, place: list[float], turn: list[float], now_ns: int) -> list[float]:
        """m/s and rad/s since the state before."""
        was_place, was_turn = self._before
        passed_s = (now_ns - self._before_ns) / 1e9
        self._before, self._before_ns = (place, turn), now_ns
        turned = times(turn, inverse(was_turn))
        way = [now - was for now, was in zip(place, was_place, strict=True)]
        return [value / passed_s for value in (*way, *(2 * half for half in turned[:3]))]


def arrived(queue: SimpleQueue) -> list[zenoh.Sample]:
    """All samples that wait in a queue."""
    found = []
    while True:
        try:
            found.append(queue.get_nowait())
        except Empty:
            return found


def put(queue: SimpleQueue) -> bool:
    """Whether anything was put; deletions do not count."""
    return any(sample.kind == zenoh.SampleKind.PUT for sample in arrived(queue))


def main(
    endpoint: str = "tcp/127.0.0.1:7447", robot: str = "vla/panda", silence_s: str = "0.1"
) -> None:
    """Run until it is ended; `silence_s` is the profile's `timing.command_timeout_s`."""
    with open_session(endpoint) as session:
        arm = Arm(float(silence_s))
        node = Node(session, robot, "arm")
        states = States(node)
        commands = {"joint": arm.follow, "gripper": arm.grip}
        queues = {
            key: SimpleQueue() for key in ("stop", "reset", *(f"command/{one}" for one in commands))
        }
        subscribers = [
            session.declare_subscriber(f"{robot}/{key}", queue.put) for key, queue in queues.items()
        ]
        next_s = time.monotonic()
        while subscribers:
            if put(queues["reset"]):
                arm.reset()
            if put(queues["stop"]):  # after the reset: of both at once the stop counts
                arm.stop()
            for kind, obey in commands.items():
                for sample in arrived(queues[f"command/{kind}"]):
                    try:
                        obey(*read(sample))
                    except Rejected as rejected:
                        node.rejected[f"{kind}_{rejected.reason}"] += 1
            arm.tick()
            states.publish(arm)
            node.publish_status("running" if arm.mode == "ready" else arm.mode)
            next_s = max(next_s + PERIOD_S, time.monotonic())
            time.sleep(max(next_s - time.monotonic(), 0.0))


if __name__ == "__main__":
    main(*sys.argv[1:])
