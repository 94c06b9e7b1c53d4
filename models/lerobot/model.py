# /// script
# requires-python = ">=3.12,<3.14"
# dependencies = [
#     "lerobot==0.6.1",
#     "numpy>=1.26",
#     "pin>=4",
#     "safetensors==0.8.0",
#     "vla-zenoh-policy-servers",
# ]
# ///
"""Any policy that LeRobot saved (ACT, SmolVLA, pi0, ...), run by LeRobot itself.

A policy directory does not define the meaning of its numbers. The data set that it was trained on
does, if it is ours (dataset.py); else the options do, which override it. They are checked against
the sizes in its config. Weights are read from safetensors; nothing is unpickled.
Of a robot of several arms they say what the numbers of each are. The arms' numbers follow one
another in the state and in the actions, as in ALOHA's data.

Several robots are answered by one pass of ACT, pi0, pi0.5 or SmolVLA, by one for each length of
the steps in execution. Other policies, and those that are asked step by step, answer one robot
after another: each has its own queues, all have the same weights.

    vla-zenoh worker lerobot --set checkpoint=DIR
    vla-zenoh worker lerobot --set checkpoint=DIR --set state=position+rpy+gripper_m \\
        --set action=delta --set rotation=rpy --set gripper=absolute_m --set dt_s=0.1
"""

from __future__ import annotations

import copy
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_model_lerobot.dataset import dataset_options
from vla_zenoh_model_lerobot.environment import EXTRAS, policy_folder, requirement
from vla_zenoh_model_lerobot.mapping import (
    ACTION,
    BATCHED,
    CONFIG,
    NOISY,
    PIPELINES,
    STATE,
    WITHOUT_WORDS,
    arm_names,
    check_weights,
    device_step,
    features,
    horizon,
    one_by_one,
    picture_size,
    pictures,
    read_config,
    state_parts,
    takes_prefix,
)
from vla_zenoh_model_lerobot.normalisation import IDENTITY, Scaled, check_statistics
from vla_zenoh_policy_servers.action_semantics import ActionSemantics, read_action_semantics
from vla_zenoh_policy_servers.state_vector import (
    StateNumbers,
    names_of_part,
    only_others_grip,
    parts_of,
    state_numbers,
)

from vla_zenoh.errors import SpecError, WorkerError, in_words
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
    Resize,
)
from vla_zenoh.policy.inference import Committed
from vla_zenoh.policy.options import checkpoint_folder, one_of
from vla_zenoh.profile import load_profile


class LeRobot:
    """A policy that LeRobot saved; see the module.

    Args:
        checkpoint: directory with ``config.json``, ``model.safetensors`` and the two pipelines.
        state: what the numbers of ``observation.state`` are, in order, see
            vla_zenoh_policy_servers.state_vector.
        map: ``feature=camera:NAME`` if the names differ, separated by commas; ``feature=`` leaves
            an image out. Others are from the camera named like their last part.
        size: of the images, WIDTHxHEIGHT; empty: as the camera gives them; ``auto``: that of the
            config, and as the camera gives them where a policy resizes them itself.
        resize: how an image of another size becomes one of this.
        device: as torch names it; ``auto``: a GPU where there is one.
        profile: of the robot: its arms and grippers.
        parts: names of the arms in the order of the policy's numbers, separated by commas; empty:
            as in the profile.
        dataset: folder of the data set that says what the numbers mean; empty: the one that the
            training names, if it is there.
        rtc: ``on``: a pi0, pi0.5 or SmolVLA continues the steps in execution, by LeRobot's own
            real-time chunking with the weights of the paper.
        meaning: of the actions, see vla_zenoh_policy_servers.action_semantics. `horizon` defaults
            to the number of steps that the policy was made to execute.
    """

    def __init__(
        self,
        checkpoint: str,
        state: str = "",
        map: str = "",
        size: str = "auto",
        resize: str = "none",
        device: str = "auto",
        profile: str = "panda_sim",
        parts: str = "",
        dataset: str = "",
        rtc: str = "off",
        **meaning: str,
    ) -> None:
        self._folder = policy_folder(checkpoint_folder(checkpoint))
        config = read_config(self._folder)
        kind = self._kind = config["type"]
        self._one_by_one = one_by_one(config)
        self.takes_committed = takes_prefix(config, rtc)
        self._modes: Any = config.get("normalization_mapping")
        steps = 1 if self._one_by_one else horizon(config, meaning.get("horizon", ""))
        one_of("resize", resize, get_args(Resize))
        robot = load_profile(profile)
        known = dataset_options(self._folder, dataset)
        state, parts = state or known.get("state", ""), parts or known.get("parts", "")
        arms = {name: robot.of_part(name) for name in arm_names(parts, tuple(robot.parts))}
        told = {**meaning, "horizon": str(steps)}
        self._meaning: dict[str, ActionSemantics] = {
            name: read_action_semantics(
                {**told, "gripper": "none"} if only_others_grip(name, arms) else told,
                known,
                "the data set",
                joints=arm.robot.arm_joints,
            )
            for name, arm in arms.items()
        }
        inputs = features(self._folder, config, "input_features")
        self._pictures = pictures(inputs, map, kind)
        joints = [len(arm.robot.arm_joints) for arm in arms.values()]
        names = state_parts(self._folder, kind, inputs, state, joints)
        self._state: dict[str, StateNumbers] = {
            name: state_numbers(
                names_of_part(names, name, arms), arm, self._meaning[name].state_units
            )
            for name, arm in arms.items()
            if names
        }
        self._check_action(config)
        self._device = device
        cameras: list[CameraSpec] = []
        for camera, (_, shape) in self._pictures.items():
            given = picture_size(size, shape, kind)
            wide, high = given or (None, None)
            how = resize if given else "none"
            cameras.append(CameraSpec(camera=camera, width=wide, height=high, resize=how))
        self.spec = ModelSpec(
            name="lerobot",
            every_step=self._one_by_one,
            observation=ObservationSpec(
                cameras=tuple(cameras),
                state=parts_of(names),
                prompt=kind not in WITHOUT_WORDS,
            ),
            action=self._meaning[""].spec
            if "" in self._meaning
            else ActionSpec.of_parts({name: own.spec for name, own in self._meaning.items()}),
        )
        self.policy: Any = None
        self._before: Any = None
        self._after: Any = None
        self._batched = kind in BATCHED and not self._one_by_one
        self._noise: dict[str, Any] = {}
        """Robot -> the generator of its noise, so that nobody else's inferences change it."""
        self._own: dict[str, Any] = {}
        """Robot -> the policy with the queues of its episode."""

    def _check_action(self, config: Mapping[str, Any]) -> None:
        shape = features(self._folder, config, "output_features").get(ACTION)
        counts = [
            (f"{part} {name}".strip(), count)
            for part, own in self._meaning.items()
            for name, count in own.parts().items()
        ]
        total = sum(count for _, count in counts)
        if shape != (total,):
            wanted = " + ".join(f"{name} {count}" for name, count in counts)
            raise WorkerError(
                f"{self._folder}: its actions have shape {shape}; {wanted} are ({total},). Is "
                "action= what they are, and has the robot as many arms?"
            )

    def load(self) -> None:
        """Read weights and pipelines.

        Raises:
            WorkerError: they are missing, damaged or not of this LeRobot.
        """
        import torch
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors
        from lerobot.utils.import_utils import register_third_party_plugins

        device = self._device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        overrides = {
            name: {"device_processor": {"device": device}} if has_device else {}
            for name, has_device in ((file, device_step(self._folder / file)) for file in PIPELINES)
        }
        check_weights(self._folder)
        self._check_statistics()
        try:
            torch.zeros(1, device=device)
            register_third_party_plugins()
            config = PreTrainedConfig.from_pretrained(self._folder, local_files_only=True)
            config.device = device
            # All weights are in the directory: none are fetched to be overwritten.
            if hasattr(config, "pretrained_backbone_weights"):
                config.pretrained_backbone_weights = None
            if self.takes_committed:
                config.rtc_config = _rtc_config(self.spec.action.horizon)  # pyright: ignore
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
            hint = self._what_to_install(error)
            raise WorkerError(
                f"LeRobot cannot load {self._folder}: {in_words(error)}{hint}"
            ) from error
        bad = [n for n, w in self.policy.named_parameters() if not torch.isfinite(w).all()]
        if bad:
            raise WorkerError(f"weight {bad[0]} in {self._folder} holds NaN or infinity")
        self.reset()

    def _what_to_install(self, error: Exception) -> str:
        """What brings a missing library, or the type of a plug-in; else empty."""
        if self._kind not in EXTRAS:
            return (
                f"; {self._kind!r} is no policy of LeRobot's own: install its plug-in "
                f"(lerobot_policy_{self._kind} or alike) beside LeRobot and vla-zenoh, and name "
                "that environment with --python"
            )
        if isinstance(error, ImportError):
            return f"; a policy {self._kind!r} needs: pip install '{requirement(self._kind)}'"
        return ""

    def _check_statistics(self) -> None:
        """Reject pipelines that would pass on unscaled what the config says is scaled.

        Raises:
            WorkerError: names the feature, and what its statistics lack.
        """
        modes = self._modes
        if not isinstance(modes, Mapping):
            raise WorkerError(
                f"{self._folder / CONFIG} has no normalization_mapping, which says how numbers are "
                "scaled: save the policy again with LeRobot 0.4 or later"
            )
        columns = sum(sum(own.parts().values()) for own in self._meaning.values())
        action = Scaled(ACTION, "ACTION", (columns,), modes.get("ACTION", IDENTITY))
        state = sum(own.size for own in self._state.values())
        before = [
            Scaled(feature, "VISUAL", shape, modes.get("VISUAL", IDENTITY))
            for feature, shape in self._pictures.values()
        ]
        if state:
            before.append(Scaled(STATE, "STATE", (state,), modes.get("STATE", IDENTITY)))
        if self.takes_committed:  # the steps in execution are scaled, too
            before.append(action)
        for file, wanted in zip(PIPELINES, (before, [action]), strict=True):
            check_statistics(self._folder / file, wanted)

    def reset(self, robot: str = "") -> None:
        """Forget what was seen and planned in the last episode of a robot; empty: of all."""
        own = [policy for name, policy in self._own.items() if robot in ("", name)]
        for part in (*own, self._before, self._after):
            if part is not None:
                part.reset()

    def infer(self, observation: Observation, committed: Committed | None = None) -> ActionSteps:
        """The next chunk by LeRobot's own pipelines and policy.

        The pipeline that scales observations scales the steps in execution too, as in training.

        Raises:
            SpecError: the policy's answer does not match its config.
        """
        return self._pass([observation], committed)[0]

    def infer_batch(
        self,
        observations: Sequence[Observation],
        committed: Sequence[Committed | None] | None = None,
    ) -> list[ActionSteps]:
        """The next chunk of each robot, what `infer` answers to each.

        Raises:
            SpecError: the policy's answer does not match its config.
        """
        prefixes = committed or [None] * len(observations)
        together: dict[Any, list[int]] = {}
        for index, (seen, prefix) in enumerate(zip(observations, prefixes, strict=True)):
            sizes = tuple(seen.images[camera].shape for camera in self._pictures)
            # One guidance for all of a pass: LeRobot takes one delay and one number of steps.
            steps = prefix and (prefix.frozen, len(prefix.steps))
            alone = None if self._batched else index
            together.setdefault((sizes, steps, alone), []).append(index)
        answers: dict[int, ActionSteps] = {}
        for indices in together.values():
            of_pass = [observations[index] for index in indices]
            found = self._pass(of_pass, *(prefixes[index] for index in indices))
            answers.update(zip(indices, found, strict=True))
        return [answers[index] for index in range(len(observations))]

    def _pass(
        self, observations: Sequence[Observation], *committed: Committed | None
    ) -> list[ActionSteps]:
        """One pass through the policy; `committed` have one length, or all are None."""
        import torch

        # LeRobot's guidance takes a gradient, which inference mode cannot.
        with torch.no_grad() if self.takes_committed else torch.inference_mode():
            batch = self._before(self._collate(observations, committed))
            first = committed[0]
            policy = self._policy_of(observations[0].robot)
            if self._one_by_one:
                wanted = policy.select_action(batch)[:, None]
            else:
                extra = self._noise_of(observations)
                if first is not None:
                    extra |= {
                        "prev_chunk_left_over": batch.pop(ACTION),
                        "inference_delay": first.frozen,
                        "execution_horizon": len(first.steps),
                    }
                chunk = policy.predict_action_chunk(batch, **extra)
                if chunk.ndim != 3 or len(chunk) != len(observations):
                    raise SpecError(
                        f"the policy's chunk has shape {tuple(chunk.shape)}, wanted "
                        f"({len(observations)}, steps, numbers)"
                    )
                wanted = chunk[:, : self.spec.action.horizon]
            # Step by step, as LeRobot does: some pipelines know no chunks.
            steps = torch.stack([self._after(step) for step in wanted.unbind(1)], dim=1)
        rows, raw = steps.double().cpu().numpy(), wanted.float().cpu().tolist()
        return [
            ActionSteps(self._steps(own), raw={"normalised": normalised})
            for own, normalised in zip(rows, raw, strict=True)
        ]

    def _collate(
        self, observations: Sequence[Observation], committed: Sequence[Committed | None]
    ) -> dict[str, Any]:
        """What LeRobot's pipeline takes, with the robots along the first axis."""
        import torch
        from lerobot.policies.utils import prepare_observation_for_inference

        device = torch.device(self.policy.config.device)
        each = [
            prepare_observation_for_inference(self._given(seen, prefix), device, seen.prompt)
            for seen, prefix in zip(observations, committed, strict=True)
        ]
        return {
            name: torch.cat([one[name] for one in each])
            if isinstance(value, torch.Tensor)
            else [one[name] for one in each]
            for name, value in each[0].items()
        }

    def _given(self, observation: Observation, committed: Committed | None) -> dict[str, Any]:
        given: dict[str, Any] = {
            # Copied: arrays from the bus are read-only, which torch does not accept.
            feature: np.array(observation.images[camera])
            for camera, (feature, _) in self._pictures.items()
        }
        if self._state:
            parts = [
                numbers.encode(observation.parts.get(part, observation))
                for part, numbers in self._state.items()
            ]
            given[STATE] = np.concatenate(parts)
        if committed is not None:
            given[ACTION] = self._rows(committed.steps).astype(np.float32)
        return given

    def _policy_of(self, robot: str) -> Any:
        """The policy with a robot's own queues; weights are the same object for all."""
        if self._batched:
            return self.policy
        if robot not in self._own:
            own = self._own[robot] = self._another() if self._own else self.policy
            own.reset()
        return self._own[robot]

    def _another(self) -> Any:
        """The policy with the same modules, and with everything else of its own."""
        import torch

        own = copy.copy(self.policy)
        for name in vars(own).keys() - vars(torch.nn.Module()).keys():
            setattr(own, name, copy.deepcopy(getattr(own, name)))
        return own

    def _noise_of(self, observations: Sequence[Observation]) -> dict[str, Any]:
        """Where a flow begins, from a generator for each robot; empty: the policy has none."""
        if self._kind not in NOISY:
            return {}
        import torch

        config = self.policy.config
        shape = (1, config.chunk_size, config.max_action_dim)
        drawn: list[torch.Tensor] = []
        for seen in observations:
            generator = self._noise.get(seen.robot)
            if generator is None:
                seed = torch.initial_seed() ^ zlib.crc32(seen.robot.encode())
                generator = self._noise[seen.robot] = torch.Generator().manual_seed(seed)
            drawn.append(torch.randn(shape, generator=generator))
        return {"noise": torch.cat(drawn).to(config.device)}

    def _steps(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Action steps (H, D) of the policy's own numbers (H, C)."""
        ends = np.cumsum([sum(own.parts().values()) for own in self._meaning.values()])
        each = zip(self._meaning.values(), np.split(rows, ends[:-1], axis=1), strict=True)
        return np.concatenate([own.steps(columns) for own, columns in each], axis=1)

    def _rows(self, steps: NDArray[Any]) -> NDArray[np.float64]:
        """The inverse of `_steps`."""
        each = [(own, self.spec.action.columns(part)) for part, own in self._meaning.items()]
        return np.concatenate([own.rows(steps[:, columns]) for own, columns in each], axis=1)


def _rtc_config(horizon: int) -> Any:
    from lerobot.configs import RTCAttentionSchedule
    from lerobot.policies.rtc.configuration_rtc import RTCConfig

    schedule = RTCAttentionSchedule.EXP  # equation 5 of the paper
    return RTCConfig(prefix_attention_schedule=schedule, execution_horizon=horizon)
