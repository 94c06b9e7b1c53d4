# /// script
# requires-python = ">=3.12,<3.14"
# dependencies = [
#     "example-robot-data>=6",
#     "lerobot[pi,smolvla]==0.6.1",
#     "numpy>=1.26",
#     "pin>=4",
#     "safetensors==0.8.0",
# ]
# ///
"""Any policy that LeRobot saved (ACT, SmolVLA, pi0, ...), run by LeRobot itself.

A policy directory does not say what its numbers mean, so the options do, and what they say is
checked against the sizes in its config. Weights are read from safetensors; nothing is unpickled.

    vla-zenoh worker lerobot --set checkpoint=DIR --set dt_s=0.1 --set kind=delta \\
        --set rotation=rpy --set gripper=open_fraction --set state=position+rpy+gripper_m
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_model_lerobot.mapping import (
    ACTION,
    PIPELINES,
    STATE,
    WEIGHTS,
    WITHOUT_WORDS,
    device_step,
    features,
    horizon,
    one_by_one,
    pictures,
    read_config,
    state_parts,
)

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.interop.joints import Forward, make_forward, poses_of
from vla_zenoh.interop.layout import Action
from vla_zenoh.model_options import checkpoint_folder, number, one_of, yes_no
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    Frame,
    GripperMeaning,
    ModelSpec,
    Observation,
    ObservationSpec,
    Resize,
    Rotation,
)
from vla_zenoh.profile import load_profile
from vla_zenoh.state_vector import parts_of, state_vector


class LeRobot:
    """See the module.

    Args:
        checkpoint: directory with ``config.json``, ``model.safetensors`` and the two pipelines.
        kind: an action is a ``delta`` or an ``absolute`` pose of the TCP, a ``joint_position``, or
            a ``joint_delta`` on the step before. Joints become poses by the arm's kinematics.
        rotation: form of a pose's rotation: ``rpy``, ``rotvec`` or ``quaternion``.
        gripper: meaning of its last number, see `vla_zenoh.policy.ActionSpec`.
        dt_s: duration of a step: 1 / fps of the data.
        frame: axes of a delta, ``base`` or ``tcp``.
        open_is_high: ``yes``: a large gripper number means open.
        scale_m: metres of one unit of position.
        joint_scale_rad: radians of one unit of a joint; 0.0174533 for degrees.
        state: what the numbers of ``observation.state`` are, in order, see `state_vector`.
        cameras: ``camera=feature`` where the names differ, separated by commas; a feature without
            one takes the camera of its own last name.
        resize: how a picture of another size becomes the one of the config.
        steps: of each chunk that are sent; by default as many as the policy was made to carry out.
        device: as torch names it; ``auto``: a GPU where there is one.
        profile: of the robot: its gripper and, where actions are joints, its arm.
    """

    def __init__(
        self,
        checkpoint: str = "",
        kind: str = "",
        rotation: str = "",
        gripper: str = "",
        dt_s: str = "",
        frame: str = "base",
        open_is_high: str = "yes",
        scale_m: str = "1",
        joint_scale_rad: str = "1",
        state: str = "",
        cameras: str = "",
        resize: str = "none",
        steps: str = "",
        device: str = "auto",
        profile: str = "panda_sim",
    ) -> None:
        self._folder = checkpoint_folder(checkpoint)
        config = read_config(self._folder)
        one_of("kind", kind, get_args(Action))
        self._joints = kind in ("joint_position", "joint_delta")
        self._deltas = kind == "joint_delta"
        self._joint_scale_rad = number("joint_scale_rad", joint_scale_rad)
        for name, value, allowed in (
            ("rotation", "quaternion" if self._joints else rotation, get_args(Rotation)),
            ("gripper", gripper, get_args(GripperMeaning)),
            ("frame", frame, get_args(Frame)),
            ("resize", resize, get_args(Resize)),
        ):
            one_of(name, value, allowed)
        if not dt_s:
            raise WorkerError("how long is a step? Say --set dt_s=SECONDS, which is 1 / fps")
        inputs = features(self._folder, config, "input_features")
        self._pictures = pictures(inputs, cameras)
        self._profile = load_profile(profile)
        self._state = state_parts(inputs, state, len(self._profile.robot.arm_joints))
        self._max_width_m = self._profile.robot.gripper.max_width_m
        self._one_by_one = one_by_one(config)
        most = 1 if self._one_by_one else horizon(config, steps)
        self._device = device
        seen = (*parts_of(self._state), *(("joint",) if self._joints else ()))
        self.spec = ModelSpec(
            name="lerobot",
            observation=ObservationSpec(
                cameras=tuple(
                    CameraSpec(
                        camera=camera,
                        height=shape[1],
                        width=shape[2],
                        resize=resize,
                    )
                    for camera, (_, shape) in self._pictures.items()
                ),
                state=tuple(dict.fromkeys(seen)),
                prompt=config["type"] not in WITHOUT_WORDS,
            ),
            action=ActionSpec(
                horizon=most,
                dt_s=number("dt_s", dt_s),
                kind="delta" if kind == "delta" else "absolute",
                frame="base" if self._joints else frame,
                rotation="quaternion" if self._joints else rotation,
                position_scale_m=number("scale_m", scale_m),
                gripper=gripper,
                gripper_open_is_high=yes_no("open_is_high", open_is_high),
            ),
        )
        self._check_action(config)
        self._forward: Forward | None = None
        self.policy: Any = None
        self._before: Any = None
        self._after: Any = None

    def _check_action(self, config: Mapping[str, Any]) -> None:
        shape = features(self._folder, config, "output_features").get(ACTION)
        action, wanted = self.spec.action, self.spec.action.dimension
        arm = f"position and {action.rotation}"
        if self._joints:
            names = self._profile.robot.arm_joints
            arm, wanted = f"{len(names)} joints", len(names) + (action.gripper != "none")
        if shape != (wanted,):
            raise WorkerError(
                f"{self._folder}: its actions have shape {shape}; {arm} with gripper "
                f"{action.gripper!r} are ({wanted},). Is it one arm, and is kind= what they are?"
            )

    def load(self) -> None:
        """Read weights and pipelines.

        Raises:
            WorkerError: they are missing, damaged or not of this LeRobot.
        """
        import torch
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        device = self._device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        overrides = {
            name: {"device_processor": {"device": device}} if has_device else {}
            for name, has_device in ((file, device_step(self._folder / file)) for file in PIPELINES)
        }
        if not (self._folder / WEIGHTS).is_file():
            raise WorkerError(f"{self._folder} holds no {WEIGHTS}; other formats are pickles")
        try:
            torch.zeros(1, device=device)
            config = PreTrainedConfig.from_pretrained(self._folder, local_files_only=True)
            config.device = device
            # All weights are in the directory: none are fetched to be overwritten.
            if hasattr(config, "pretrained_backbone_weights"):
                config.pretrained_backbone_weights = None
            self.policy = get_policy_class(config.type).from_pretrained(
                self._folder, config=config, strict=True
            )
            self._before, self._after = make_pre_post_processors(
                config,
                pretrained_path=str(self._folder),
                preprocessor_overrides=overrides[PIPELINES[0]],
                postprocessor_overrides=overrides[PIPELINES[1]],
            )
        except Exception as error:  # LeRobot raises whatever its libraries do
            raise WorkerError(
                f"LeRobot cannot load {self._folder}: {type(error).__name__}: {str(error)[:500]}"
            ) from error
        if self._joints:
            self._forward = make_forward(self._profile)
        bad = [n for n, w in self.policy.named_parameters() if not torch.isfinite(w).all()]
        if bad:
            raise WorkerError(f"weight {bad[0]} in {self._folder} holds NaN or infinity")
        self.reset()

    def reset(self) -> None:
        """Forget what was seen and planned in the last episode."""
        for part in (self.policy, self._before, self._after):
            if part is not None:
                part.reset()

    def infer(self, observation: Observation) -> ActionSteps:
        """The next chunk by LeRobot's own pipelines and policy.

        Raises:
            SpecError: the policy answers with something else than its config says.
        """
        import torch
        from lerobot.policies.utils import prepare_observation_for_inference

        given: dict[str, Any] = {
            # Copied: what came by the bus may not be written to, and torch takes no such arrays.
            feature: np.array(observation.images[camera])
            for camera, (feature, _) in self._pictures.items()
        }
        if self._state:
            given[STATE] = state_vector(self._state, observation, self._max_width_m)
        with torch.inference_mode():
            device = torch.device(self.policy.config.device)
            batch = self._before(
                prepare_observation_for_inference(given, device, observation.prompt)
            )
            if self._one_by_one:
                wanted = self.policy.select_action(batch)[:, None]
            else:
                chunk = self.policy.predict_action_chunk(batch)
                if chunk.ndim != 3:
                    raise SpecError(f"the policy's chunk has shape {tuple(chunk.shape)}")
                wanted = chunk[:, : self.spec.action.horizon]
            # Step by step, as LeRobot does: some pipelines know no chunks.
            steps = torch.cat([self._after(step) for step in wanted.unbind(1)])
        raw = {"normalised": wanted[0].float().cpu().tolist()}
        return ActionSteps(self._meant(steps.double().cpu().numpy(), observation), raw=raw)

    def _meant(self, steps: NDArray[np.float64], observation: Observation) -> NDArray[np.float64]:
        """(H, D) in the meaning of the spec."""
        if self._forward is None or observation.joint is None:
            return steps
        count = len(self._profile.robot.arm_joints)
        arm, gripper = self._joint_scale_rad * steps[:, :count], steps[:, count:]
        poses = poses_of(arm, observation.joint, self._forward, deltas=self._deltas)
        return np.concatenate([poses, gripper], axis=1)
