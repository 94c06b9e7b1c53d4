"""An arm on the bus as a leader of LeRobot."""

from __future__ import annotations

from contextlib import ExitStack
from functools import cached_property
from typing import Any

from lerobot.teleoperators import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError

import vla_zenoh
from lerobot_robot_vla_zenoh.config import VlaZenohTeleopConfig, arm_profile
from lerobot_robot_vla_zenoh.numbers import ArmNumbers
from vla_zenoh.errors import VlaZenohError


class VlaZenohTeleop(Teleoperator):
    """A leader: the measured joints of an arm, which it neither activates nor moves.

    Its numbers are those of `lerobot_robot_vla_zenoh.robot.VlaZenoh`.
    """

    config_class = VlaZenohTeleopConfig
    name = "vla_zenoh"

    def __init__(self, config: VlaZenohTeleopConfig) -> None:
        super().__init__(config)
        self.config = config
        self._numbers = ArmNumbers(arm_profile(config.profile), fps=1)
        self._opened = ExitStack()
        self._remote: vla_zenoh.RemoteRobot | None = None

    @cached_property
    def action_features(self) -> dict[str, type]:
        return self._numbers.features()

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._remote is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to do: the leader's driver has its calibration."""

    def configure(self) -> None:
        """Nothing to do: the profile is its configuration."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Join the bus.

        Raises:
            DeviceNotConnectedError: no router, or no state of the leader.
        """
        with ExitStack() as opened:
            try:
                remote = opened.enter_context(
                    vla_zenoh.connect(self.config.profile, endpoints=self.config.endpoints)
                )
            except VlaZenohError as error:
                raise DeviceNotConnectedError(f"{self}: {error}") from error
            self._numbers.measured(remote)
            self._remote, self._opened = remote, opened.pop_all()

    @check_if_not_connected
    def get_action(self) -> dict[str, float]:
        """Where the leader is.

        Raises:
            DeviceNotConnectedError: it sends no states.
        """
        assert self._remote is not None
        return self._numbers.measured(self._remote)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """A leader takes none; LeRobot asks no arm of this kind for it."""
        raise NotImplementedError("a leader of vla_zenoh takes no feedback")

    @check_if_not_connected
    def disconnect(self) -> None:
        """Leave the bus."""
        self._remote = None
        self._opened.close()
