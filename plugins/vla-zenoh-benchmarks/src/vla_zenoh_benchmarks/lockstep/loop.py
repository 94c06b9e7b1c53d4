"""The lockstep loop: virtual time, message delivery, and a tick of every node."""

from __future__ import annotations

import heapq
import random
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec import records
from vla_zenoh.codec.image import (
    decode_depth,
    decode_raw,
    depth_schema,
    encode_depth,
    encode_raw,
    raw_schema,
)
from vla_zenoh.control.commander import Commander, Inputs, Outputs, Setting
from vla_zenoh.control.commander_io import NewStates
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import CodecError
from vla_zenoh.guard.arm_guard import ArmGuard, GripperGuard, Measured
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy import Policy
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    ActionChunk,
    Depth,
    Event,
    FloatArray,
    GripperCommand,
    GripperState,
    Header,
    HeldBox,
    Image,
    JointState,
    PoseState,
    Stamped,
    Task,
)
from vla_zenoh_benchmarks.lockstep.worker import (
    Delays,
    LockstepTrace,
    LockstepWorker,
    Message,
    Tamper,
)

TICK_NS = 1_000_000
"""One step of the world."""
START_NS = 1_700_000_000_000_000_000
"""Start of the virtual wall clock."""
SIM, CAMERA, COMMAND = "sim", "camera", "command"


class LockstepArm(Protocol):
    """An arm of what the loop steps, see `simulation.world.SimulatedPart`."""

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]: ...
    @property
    def slides(self) -> NDArray[np.bool_]: ...
    def tcp(self) -> tuple[FloatArray, FloatArray]: ...
    def joint_state(self) -> JointState: ...
    def pose_state(self, reference: Any, /) -> PoseState: ...
    def gripper_state(self) -> GripperState: ...
    def set_gripper(self, width_m: float, speed_m_s: float, force_n: float, /) -> None: ...


class LockstepWorld(LockstepArm, Protocol):
    """What the loop steps: the simulated `World`, or what stands in for it, of one arm."""

    def tick(self, reference: Any, /) -> None: ...


class Lockstep:
    """All nodes of one robot in lockstep. `put` publishes a setting, `run` advances time.

    Args:
        policy: the model; its ``load`` is called here if it has one.
        picture: image of a camera, by name; None: small gray images with a little noise.
        reach: see `Commander`.
        others: more workers, by name; they run without effect until selected.
        steps: of the world in a tick, all towards the reference of its end; the simulator's node
            takes two.
    """

    def __init__(
        self,
        profile: Profile,
        world: LockstepWorld,
        policy: Policy,
        *,
        delays: Delays | None = None,
        picture: Callable[[str], Image] | None = None,
        reach: ReachabilityFilter | Mapping[str, ReachabilityFilter] | None = None,
        seed: int = 0,
        others: Mapping[str, Policy] | None = None,
        steps: int = 1,
    ) -> None:
        self.profile = profile
        self._steps, self._tick_ns = steps, steps * TICK_NS
        self.world: Any = world
        self.delays = delays or Delays()
        self.now_ns = START_NS
        self.commander = Commander(profile, reach=reach)
        self.guards = {
            name: ArmGuard(
                profile.of_part(name),
                partial(self._measure, name),
                self._arm(name).joint_range_rad,
                np.full(len(profile.of_part(name).robot.arm_joints), np.inf),
                self._arm(name).slides,
                self._tick_ns / 1e9,
            )
            for name in profile.part_names
        }
        self.guard = next(iter(self.guards.values()))
        self.tamper: Tamper | None = None
        self.trace = LockstepTrace()
        self.events: list[Event] = []
        self.refused: Counter[str] = Counter()
        self._gripper_guards = {
            name: GripperGuard(gripper)
            for name in self.guards
            if (gripper := profile.of_part(name).robot.gripper) is not None
        }
        self.guard_refused: Counter[str] = Counter()
        policies = {profile.task.worker: policy, **(others or {})}
        self.workers = {
            name: LockstepWorker(profile, name, each, self.delays, random.Random(seed + index))
            for index, (name, each) in enumerate(policies.items())
        }
        self.alive = {SIM, CAMERA, COMMAND, *(w.source for w in self.workers.values())}
        self.camera_faults: dict[str, str] = {}
        self._clock_ns: Counter[str] = Counter()
        self._picture = picture or (lambda _: _gray(self._seq[CAMERA]))
        self._arrivals: list[tuple[int, int, Callable[[], None]]] = []
        self._sent = 0
        self._seq: Counter[str] = Counter()
        self._inbox = Inputs([], [])
        self._prepared = True  # as in the command node: after the first tick, once in each period
        self._next_command_ns = self._next_state_ns = self._next_picture_ns = START_NS
        self._publish_states()

    # -- from outside -------------------------------------------------------------------------
    def put(
        self, name: str, value: str | bool | float | HeldBox | None = None, part: str = ""
    ) -> None:
        """Publish a setting, for the next tick of the commander."""
        self._inbox.settings = [*self._inbox.settings, Setting(name, value, part=part)]

    def run(self, duration_s: float) -> None:
        end_ns = self.now_ns + round(duration_s * 1e9)
        while self.now_ns < end_ns:
            self._tick()

    def run_until(self, condition: Callable[[], bool], limit_s: float) -> bool:
        """Advance time until `condition` holds, at most by `limit_s`; whether it holds."""
        end_ns = self.now_ns + round(limit_s * 1e9)
        while not condition() and self.now_ns < end_ns:
            self._tick()
        return condition()

    def activate(self, patience_s: float, period_s: float) -> str:
        """Activate, again and again; the last rejection, empty: the arm is active."""
        end_ns = self.now_ns + round(patience_s * 1e9)
        while not self.commander.task.active:
            if self.now_ns >= end_ns:
                whys = [event.why for event in self.events if event.what == "activate_refused"]
                return whys[-1] if whys else "activation was rejected"
            self.put("active", True)
            self.run(period_s)
        return ""

    def set_clock(self, node: str, offset_s: float) -> None:
        """Set the wall clock of `node` (its stamps are its source) to this much past the others'.

        The command node answers a step of its own clock as `vla_zenoh.nodes.command.node` does.
        """
        offset_ns = round(offset_s * 1e9)
        step_s = (offset_ns - self._clock_ns[node]) / 1e9
        self._clock_ns[node] = offset_ns
        if node == COMMAND and abs(step_s) > self.profile.timing.max_clock_step_s:
            self.put("lose", f"the wall clock was set by {step_s:+.3f} s")

    def wall_ns(self, node: str) -> int:
        """The wall clock of `node`."""
        return self.now_ns + self._clock_ns[node]

    # -- one tick -----------------------------------------------------------------------------
    def _tick(self) -> None:
        self.now_ns += self._tick_ns
        if self.now_ns >= self._next_state_ns:
            self._next_state_ns += round(1e9 / self.profile.timing.state_hz)
            self._publish_states()
        if self.now_ns >= self._next_picture_ns:
            self._next_picture_ns += round(1e9 / self.delays.camera_hz)
            self._publish_pictures()
        self._receive()
        for worker in self.workers.values():
            before = worker.complaint
            chunk = worker.step(self.now_ns, self.wall_ns(worker.source))
            if worker.complaint and not before:
                self.events.append(Event("warning", "fault", "same_image", worker.complaint))
            if chunk is not None:
                # Published when the inference is over, and stamped with that time.
                end_ns = chunk.inference_end_ns - self._clock_ns[worker.source]
                self._send(worker.source, chunk, self._take_chunk, end_ns)
        self._receive()
        if self.now_ns >= self._next_command_ns:
            self._next_command_ns += round(1e9 / self.profile.timing.command_hz)
            self._command()
        now_ns = self.wall_ns(SIM)
        references = {name: guard.tick(now_ns) for name, guard in self.guards.items()}
        more = () if self._steps == 1 else (self._steps,)  # what stands in for a world knows none
        self.world.tick(references.get("", references), *more)

    def _arm(self, part: str) -> LockstepArm:
        return self.world.parts[part] if part else self.world

    def _measure(self, part: str) -> Measured:
        arm = self._arm(part)
        state = arm.joint_state()
        return Measured(Pose(*arm.tcp()), state.position_rad, state.velocity_rad_s)

    def _receive(self) -> None:
        while self._arrivals and self._arrivals[0][0] <= self.now_ns:
            heapq.heappop(self._arrivals)[2]()

    def _command(self) -> None:
        self._inbox.peers = PeerSnapshot(
            alive=frozenset(self.alive),
            robot_node=SIM,
            specs={name: worker.spec for name, worker in self.workers.items()},
            spec_sources={name: worker.source for name, worker in self.workers.items()},
            camera_ages_s=dict.fromkeys(self.profile.cameras, 0.0),
            camera_nodes=dict.fromkeys(self.profile.cameras, CAMERA),
            same_host=frozenset(self.alive),
            camera_faults=dict(self.camera_faults),
        )
        inputs, self._inbox = self._inbox, Inputs([], [])
        out = self.commander.step(inputs, self.wall_ns(COMMAND))
        self._prepared = False
        self._publish(out)
        position_m, rotation = self.world.tcp()
        self.trace.time_ns.append(self.now_ns)
        self.trace.commands.append(out.pose)
        self.trace.joints.append(out.joint)
        self.trace.parts.append(out.parts)
        self.trace.position_m.append(position_m)
        self.trace.rotation.append(rotation)
        self.trace.width_m.append(self.world.gripper_state().opening_m)

    def _publish(self, out: Outputs) -> None:
        self.events += out.events
        self.refused.update(refusal.reason for refusal in out.rejections)
        for part in self.guards:
            pose, joint, gripper = out.of(part)
            take = partial(self._take_command, self.guards[part].offer)
            for command in (pose, joint):
                if command is not None:
                    self._send(COMMAND, command, take, part=part)
            if gripper is not None:
                self._send(COMMAND, gripper, partial(self._take_gripper_command, part), part=part)
        if out.task_changed or any(worker.task is None for worker in self.workers.values()):
            self._send(COMMAND, self.commander.task, self._take_task)

    def _publish_states(self) -> None:
        for part, guard in self.guards.items():
            arm = self._arm(part)
            held = arm.pose_state(guard.reference)
            self._send(SIM, held, partial(self._take_state, part, "pose"), part=part)
            gripper = arm.gripper_state()
            if guard.braking or guard.unheeded:
                gripper = replace(gripper, mode="braking" if guard.braking else "unheeded")
            self._send(SIM, gripper, partial(self._take_state, part, "gripper"), part=part)
            looks = [worker.spec.observation for worker in self.workers.values()]
            wanted = {what for each in looks for what in each.state_streams}
            if self.commander.parts[0].reach is not None or "joint" in wanted:
                joints = arm.joint_state()
                self._send(SIM, joints, partial(self._take_state, part, "joint"), part=part)

    def _publish_pictures(self) -> None:
        self._seq[CAMERA] += 1
        header = Header(self.wall_ns(CAMERA), self._seq[CAMERA], CAMERA)
        arrival_ns = self.now_ns + round(self.delays.camera_s * 1e9)
        wanted = [worker.spec.observation for worker in self.workers.values()]
        cameras = sorted({one.camera for each in wanted for one in each.cameras})
        with_depth = sorted({one.camera for each in wanted for one in each.depth})
        shown = [(camera, self._picture(camera)) for camera in cameras]
        depth = _half_a_metre(self._seq[CAMERA])
        for camera, record in [*shown, *((camera, depth) for camera in with_depth)]:
            picture, take = Stamped(header, record, arrival_ns), partial(self._take_picture, camera)
            if self.tamper is None:  # else an image would be encoded that nobody needs
                self._deliver(arrival_ns, partial(take, picture))
                continue
            for arriving in self.tamper(_image_message(camera, picture)):
                self._deliver(arriving.arrival_ns, partial(self._arrive, arriving, take))

    # -- the wire -----------------------------------------------------------------------------
    def _send(
        self,
        source: str,
        record: Any,
        take: Callable[[Stamped[Any]], None],
        sent_ns: int | None = None,
        part: str = "",
    ) -> None:
        """Send a record; `take` receives it with the virtual time of its arrival."""
        sent_ns = self.now_ns if sent_ns is None else sent_ns
        stream = f"{source} {type(record).__name__} {part}"
        self._seq[stream] += 1
        seq = self._seq[stream]
        message = Message(
            type(record),
            Header(sent_ns + self._clock_ns[source], seq, source),
            records.encode(record),
            sent_ns + round(self.delays.wire_s * 1e9),
            part,
        )
        for arriving in [message] if self.tamper is None else self.tamper(message):
            self._deliver(arriving.arrival_ns, partial(self._arrive, arriving, take))

    def _arrive(self, message: Message, take: Callable[[Stamped[Any]], None]) -> None:
        try:
            header = records.decode_header(records.encode_header(message.header))
            record = _decoded(message)
        except CodecError as error:
            self.refused[error.reason] += 1
            return
        take(Stamped(header, record, message.arrival_ns))

    def _at(self, node: str, arrived: Stamped[Any]) -> Stamped[Any]:
        """With the time of arrival on the clock of `node`."""
        return replace(arrived, received_ns=arrived.received_ns + self._clock_ns[node])

    def _deliver(self, arrival_ns: int, arrive: Callable[[], None]) -> None:
        self._sent += 1
        heapq.heappush(self._arrivals, (arrival_ns, self._sent, arrive))

    def _take_state(self, part: str, name: str, state: Stamped[Any]) -> None:
        """A state `pose`, `joint` or `gripper`, for commander and workers."""
        newest = self._at(COMMAND, state)
        if part:
            known = self._inbox.parts.get(part) or NewStates()
            assert isinstance(known, NewStates)
            self._inbox.parts = {**self._inbox.parts, part: known._replace(**{name: newest})}
        else:
            setattr(self._inbox, name, newest)
        for worker in self.workers.values():
            worker.take_state(self._at(worker.source, state), part)

    def _take_picture(self, camera: str, picture: Stamped[Any]) -> None:
        for worker in self.workers.values():
            worker.take_picture(camera, self._at(worker.source, picture))

    def _take_task(self, task: Stamped[Task]) -> None:
        for worker in self.workers.values():
            worker.take_task(self._at(worker.source, task))

    def _take_chunk(self, chunk: Stamped[ActionChunk]) -> None:
        chunk = self._at(COMMAND, chunk)
        if self._prepared:
            self._inbox.chunks = [*self._inbox.chunks, chunk]
            return
        self._prepared, inbox = True, self._inbox
        states = replace(inbox, settings=(), chunks=[chunk], peers=None)
        inbox.pose = inbox.gripper = inbox.joint = None
        inbox.parts = {}
        left_ns = self._next_command_ns - self.now_ns
        self.commander.prepare(states, self.wall_ns(COMMAND) + left_ns)

    def _take_command(self, offer: Callable[[Any, int], str | None], command: Stamped[Any]) -> None:
        refusal = offer(self._at(SIM, command), self.wall_ns(SIM))
        if refusal is not None:
            self.guard_refused[refusal] += 1

    def _take_gripper_command(self, part: str, command: Stamped[GripperCommand]) -> None:
        guard = self.guards[part]
        try:
            order = self._gripper_guards[part].accept(
                command, guard.writer, self.wall_ns(SIM), writer_active=guard.writer_active
            )
        except CodecError as error:
            self.guard_refused[error.reason] += 1
            return
        self._arm(part).set_gripper(order.width_m, order.speed_m_s, order.force_n)


def _gray(seq: int) -> Image:
    rgb = np.full((48, 64, 3), 128, np.uint8)
    rgb[0] += np.uint8(seq % 101)  # as a sensor's noise: no image is as the last one
    return Image(rgb)


def _half_a_metre(seq: int) -> Depth:
    """What all cameras with depth measure, with a little noise."""
    counts = np.full((48, 64), 500, np.uint16)
    counts[0] += np.uint16(seq % 101)
    return Depth(counts, 0.001)


def _decoded(message: Message) -> Any:
    if message.kind is Depth:
        return decode_depth(message.payload, message.encoding)
    if message.kind is Image:
        return decode_raw(message.payload, message.encoding)
    return records.decode(message.kind, message.payload)


def _image_message(camera: str, picture: Stamped[Image] | Stamped[Depth]) -> Message:
    record = picture.record
    if isinstance(record, Depth):
        payload, encoding = encode_depth(record), depth_schema(record)
    else:
        payload, encoding = encode_raw(record), raw_schema(record)
    kind, header = type(record), picture.header
    return Message(kind, header, payload, picture.received_ns, "", camera, encoding)
