"""Episodes of a worker in the simulator on a virtual clock, recorded as on the bus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vla_zenoh_benchmarks.lockstep.loop import START_NS, Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays, Message

from vla_zenoh.codec import records
from vla_zenoh.codec.image import decode_raw, encode_jpeg
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import Policy
from vla_zenoh.profile import Profile
from vla_zenoh.profile.load import to_yaml
from vla_zenoh.simulation.backend import choose_backend
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import (
    ActionChunk,
    GripperCommand,
    GripperState,
    Header,
    Image,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Task,
)

QUALITY = 95
KEY_OF: Mapping[type, str] = {
    JointState: "state_joint",
    PoseState: "state_pose",
    GripperState: "state_gripper",
    JointCommand: "command_joint",
    PoseCommand: "command_pose",
    GripperCommand: "command_gripper",
    Task: "task",
}
READY_S, PATIENCE_S, AGAIN_S = 0.5, 5.0, 0.2


class Stage:
    """A simulated arm on a virtual clock, with pictures of its cameras as the profile has them."""

    def __init__(self, profile: Profile) -> None:
        self.profile, self._world = profile, build_world(profile)
        self._renderer = Renderer(profile.sim.scene, robot_models(profile), choose_backend(None))
        self._reach = ReachabilityFilter(profile)

    def loop(self, policy: Policy, seed: int = 0) -> Lockstep:
        """A new loop around the world with its objects as `seed` places them."""
        self._world.reset(seed)
        camera_hz = min(each.rate_hz for each in self.profile.cameras.values())
        return Lockstep(
            self.profile,
            self._world,
            policy,
            delays=Delays(camera_hz=camera_hz),
            picture=self._draw,
            reach={"": self._reach},
            seed=seed,
        )

    def _draw(self, camera: str) -> Image:
        source = self.profile.cameras[camera]
        self._renderer.set_qpos(self._world.qpos())
        scene_camera = source.source.removeprefix("sim:")
        return Image(self._renderer.render(scene_camera, source.width, source.height))


def activate(loop: Lockstep, prompt: str) -> None:
    """Activate the loop's worker with a prompt."""
    loop.put("prompt", prompt)
    loop.run(READY_S)
    assert not (why := loop.activate(PATIENCE_S, AGAIN_S)), why


def record(
    stage: Stage, policy: Policy, path: Path, prompts: Sequence[str], seconds: float
) -> Path:
    """One activation of so many seconds for each prompt; what ``vla-zenoh record`` would write."""
    loop, profile = stage.loop(policy), stage.profile
    keys, worker = profile.keys, profile.task.worker
    out = RecordingWriter(
        path,
        keys,
        profile_yaml=to_yaml(profile),
        base_frame=profile.robot.base_frame,
        began_ns=START_NS,
    )
    said = Header(START_NS, 0, f"worker-{worker}")
    out.write(Sample(keys.spec(worker), records.encode(policy.spec), MSGPACK, said, START_NS))

    def keep(message: Message) -> list[Message]:
        out.write(_sample(keys, message))
        return [message]

    loop.tamper = keep
    for prompt in prompts:
        activate(loop, prompt)
        loop.run(seconds)
        loop.put("active", False)
        loop.run(READY_S)
    out.finish()
    return path


def _sample(keys: Keys, message: Message) -> Sample:
    payload, encoding = message.payload, MSGPACK
    if message.kind is Image:
        key, encoding = keys.camera_jpeg(message.camera), JPEG
        payload = encode_jpeg(decode_raw(payload, message.encoding), QUALITY)
    elif message.kind is ActionChunk:
        key = keys.delta(records.decode(ActionChunk, payload).worker)
    else:
        key: Any = getattr(keys, KEY_OF[message.kind])
    return Sample(key, payload, encoding, message.header, message.arrival_ns)
