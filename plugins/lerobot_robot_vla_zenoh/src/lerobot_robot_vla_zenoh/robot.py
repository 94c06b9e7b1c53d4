"""An arm on the bus as a robot of LeRobot."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from functools import cached_property
from typing import Any

from lerobot.cameras import Camera, make_cameras_from_configs
from lerobot.robots import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError
from vla_zenoh_policy_servers.loop_worker import LoopWorker

import vla_zenoh
from lerobot_robot_vla_zenoh.config import VlaZenohConfig, arm_profile
from lerobot_robot_vla_zenoh.numbers import ArmNumbers
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.keys import worker_node
from vla_zenoh.profile import override

FIRST_CHUNK_S = 20.0
"""A command node that is just starting has sent its task within this."""
logger = logging.getLogger(__name__)


class VlaZenoh(Robot):
    """An arm driven through its command node: actions are the chunks of a worker.

    Positions are ``JOINT.pos`` in degrees of the description and ``gripper.pos`` from 0 shut to 100
    open, in both directions; images are RGB uint8 (height, width, 3).

    `connect` takes the arm and activates it for as long as this process lives, `disconnect` brakes
    it.
    """

    config_class = VlaZenohConfig
    name = "vla_zenoh"

    def __init__(self, config: VlaZenohConfig) -> None:
        super().__init__(config)
        self.config = config
        profile = arm_profile(config.profile)
        if config.endpoints:
            profile = override(profile, {"session": {"connect": config.endpoints}})
        self._profile = profile
        self._numbers = ArmNumbers(profile, config.fps)
        self.cameras = make_cameras_from_configs(config.cameras or {})
        self._opened = ExitStack()
        self._remote: vla_zenoh.RemoteRobot | None = None
        self._worker: LoopWorker | None = None

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        sizes = {name: (each.height, each.width, 3) for name, each in self.cameras.items()}
        return {**self._numbers.features(), **sizes}

    @cached_property
    def action_features(self) -> dict[str, type]:
        return self._numbers.features()

    @property
    def is_connected(self) -> bool:
        return self._worker is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to do: the robot's driver has its calibration."""

    def configure(self) -> None:
        """Nothing to do: the profile is its configuration."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Join the bus, take the arm and activate it.

        Raises:
            DeviceNotConnectedError: no router, robot or image, or the activation was rejected; with
                every reason.
        """
        with ExitStack() as opened:
            for camera in self.cameras.values():
                camera.connect()
                opened.callback(camera.disconnect)
            try:
                remote = opened.enter_context(vla_zenoh.connect(self._profile))
                session = open_session(
                    self._profile.session, identity=worker_node(self.config.worker)
                )
                opened.enter_context(session)
                worker = LoopWorker(
                    self._profile, session, self.config.worker, self._numbers.action
                )
                opened.callback(worker.close)
                remote.wait_for(lambda: worker.ready, FIRST_CHUNK_S)
                remote.set_worker(self.config.worker)
                remote.activate_with_deadman("lerobot")
            except VlaZenohError as error:
                raise DeviceNotConnectedError(f"{self}: {error}") from error
            self._remote, self._worker = remote, worker
            self._opened = opened.pop_all()

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        """The newest state and images, waiting for a new image where the newest is too old.

        A computer that stalls, as where LeRobot begins an episode, makes images late: the arm
        stands meanwhile, and the loop goes on.

        Raises:
            DeviceNotConnectedError: the robot sends no states.
            TimeoutError: an image is older than ``timing.max_observation_age_s``, and no new one
                comes.
        """
        assert self._remote is not None
        images = {name: self._image(each) for name, each in self.cameras.items()}
        return {**self._numbers.measured(self._remote), **images}

    def _image(self, camera: Camera) -> Any:
        try:
            return camera.read_latest(round(1e3 * self._profile.timing.max_observation_age_s))
        except TimeoutError:
            return camera.read()

    @check_if_not_connected
    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Ask the arm to be there in 1 / fps s, within all limits of its profile.

        Returns:
            what was sent: the action within the range of each joint. Workspace, collisions, speed
            and acceleration bound the way there, too; the events of the command node tell.

        Raises:
            DeviceNotConnectedError: the arm does not follow: it was stopped or deactivated, or
                another worker has it; says why.
            ValueError: a number is missing, unknown or not finite.
        """
        assert self._remote is not None
        assert self._worker is not None
        sent = self._numbers.within_range(action)
        task = self._remote.task
        if task is None or not task.active:
            raise DeviceNotConnectedError(f"{self}: not active: {self._remote.why_inactive()}")
        if task.worker != self._worker.name:
            raise DeviceNotConnectedError(f"{self}: the arm follows worker {task.worker!r} now")
        if not self._worker.send(self._numbers.step(sent)):
            raise DeviceNotConnectedError(
                f"{self}: no new state of the robot came. {self._worker.complaint}".strip()
            )
        return sent

    @check_if_not_connected
    def disconnect(self) -> None:
        """Brake the arm and leave the bus."""
        assert self._remote is not None
        task = self._remote.task
        ours = task is not None and task.active and task.worker == self.config.worker
        try:
            if ours and not self._remote.deactivate():
                logger.warning("%s: the arm is not known to stand; use its emergency stop", self)
        finally:
            self._remote = self._worker = None
            self._opened.close()
