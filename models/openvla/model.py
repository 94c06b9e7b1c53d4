# /// script
# requires-python = ">=3.11,<3.14"
# dependencies = [
#     "bitsandbytes==0.50.2",
#     "numpy>=1.26",
#     "opencv-python-headless>=4.9",
#     "pillow>=11",
#     "pin>=4",
#     "safetensors==0.8.0",
#     "timm==1.0.31",
#     "tokenizers>=0.22",
#     "torch==2.11.0",
#     "torchvision==0.26.0",
#     "transformers==5.23.0",
#     "vla-zenoh-policy-servers",
# ]
# ///
"""OpenVLA (Kim et al., CoRL 2024) from a directory of weights, as published or fine-tuned.

Input are one image and the prompt, output is one step: the motion of the TCP and the opening of the
gripper, in the units of the data. A directory fine-tuned by OpenVLA-OFT may need more images and
the robot's state, and outputs a chunk. No code of the checkpoint runs.

    vla-zenoh worker openvla --set checkpoint=DIR --set unnorm_key=bridge_orig
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from vla_zenoh_model_openvla.checkpoint import TOKENIZER, Checkpoint, read_checkpoint
from vla_zenoh_model_openvla.chunk_files import chunk_steps, find_chunk_files
from vla_zenoh_model_openvla.meaning import data_meaning
from vla_zenoh_model_openvla.picture import trained_form
from vla_zenoh_model_openvla.statistics import AXES, Range, choose, read_range
from vla_zenoh_model_openvla.tokens import PROMPTS, ActionBins, prompt_text, prompt_tokens
from vla_zenoh_policy_servers.state_vector import (
    StateNumbers,
    parts_of,
    read_state,
    state_numbers,
)

from vla_zenoh.errors import SpecError, WorkerError, in_words
from vla_zenoh.policy import ActionSteps, CameraSpec, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.options import checkpoint_folder, one_of
from vla_zenoh.profile import load_profile

Device = str
Dtype = Literal["auto", "bfloat16", "float16", "float32"]
Quantise = Literal["none", "int8", "nf4"]
Choice = Literal["auto", "yes", "no"]

AUGMENTED = "image_aug"
"""Part of the name of a run whose images were cropped, as the published fine-tuning writes it."""


class OpenVLA:
    """OpenVLA from a directory of weights; see the module.

    Args:
        checkpoint: directory with ``config.json``, ``*.safetensors`` and ``tokenizer.json``.
        unnorm_key: data set whose statistics turn numbers into metres; may be left out where there
            is only one.
        adapter: directory of a LoRA adapter that was not merged.
        cameras: the camera whose image the model gets; OFT: several, separated by commas.
        center_crop: give it the middle 90 % of the image. ``auto``: where the directory's name
            says that it was trained with ``image_aug``.
        template: prompt it was trained with, ``7b`` or ``v01``; ``auto``: by its Llama.
        device: as torch names it; ``auto``: a GPU where there is one.
        dtype: of weights; ``auto``: bfloat16 on a GPU, else float32.
        quantise: ``int8`` or ``nf4``: Llama's layers in less memory.
        chunk: OFT: steps of a chunk; known for LIBERO and Bridge.
        state: OFT: what the numbers of the robot's state are, see vla_zenoh_policy_servers.
        profile: of the robot; OFT: its gripper and arm, for the state.
        meaning: of the numbers in the units of the data, known for some data sets, see
            vla_zenoh_policy_servers.action_semantics. `horizon` defaults to the whole chunk.
    """

    def __init__(
        self,
        checkpoint: str,
        unnorm_key: str = "",
        adapter: str = "",
        cameras: str = "front",
        center_crop: str = "auto",
        template: str = "auto",
        device: str = "auto",
        dtype: str = "auto",
        quantise: str = "none",
        chunk: str = "auto",
        state: str = "",
        profile: str = "panda_sim",
        **meaning: str,
    ) -> None:
        folder = checkpoint_folder(checkpoint)
        one_of("dtype", dtype, get_args(Dtype))
        one_of("quantise", quantise, get_args(Quantise))
        one_of("center_crop", center_crop, get_args(Choice))
        one_of("template", template, ("auto", *PROMPTS))
        self._adapter = Path(adapter).expanduser() if adapter else None
        self.checkpoint: Checkpoint = read_checkpoint(folder, self._adapter)
        found = self.checkpoint
        self._key = choose(found.statistics, unnorm_key, found.statistics_file)
        self._range = read_range(found.statistics, self._key)
        self.bins = ActionBins(found.text_vocabulary, found.bins)
        self._template = found.template if template == "auto" else template
        trained = AUGMENTED in str(self._adapter or found.folder.resolve())
        self._crop = trained if center_crop == "auto" else center_crop == "yes"
        self._device, self._dtype, self._quantise = device, dtype, quantise
        self._cameras = tuple(name.strip() for name in cameras.split(","))
        self._files = find_chunk_files(self._adapter or found.folder)
        self._chunk = 1 if self._files is None else chunk_steps(chunk, self._key)
        self._meaning = data_meaning(meaning, self._key, self._range, self._chunk)
        self._state_range: Range | None = None
        self._state: StateNumbers | None = None
        robot = load_profile(profile)
        if self._files is None and (len(self._cameras) > 1 or state):
            raise WorkerError("plain OpenVLA sees one camera and no state; cameras= names one")
        if self._files is not None and self._files.state is not None:
            trained_on = read_range(found.statistics, self._key, "proprio", size=None)
            self._state_range = trained_on
            names = read_state(state, len(trained_on.low), len(robot.robot.arm_joints))
            self._state = state_numbers(names, robot, self._meaning.state_units)
        self.spec = ModelSpec(
            name="openvla",
            observation=ObservationSpec(
                # The image in full size: shrinking it is part of the training data's preparation.
                cameras=tuple(CameraSpec(camera=name) for name in self._cameras),
                state=parts_of(self._state.names if self._state else ()),
                prompt=True,
            ),
            action=self._meaning.spec,
        )
        self.network: Any = None
        self._tokenizer: Any = None
        self._head: Any = None

    def load(self) -> None:
        """Read the weights and try them once.

        Raises:
            WorkerError: they are damaged, or not those of the config.
        """
        import torch
        from tokenizers import Tokenizer
        from vla_zenoh_model_openvla.load import load_network
        from vla_zenoh_model_openvla.quantise import quantise

        device = self._device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        name = self._dtype
        if name == "auto":
            name = "float32" if device == "cpu" else "bfloat16"
        file = self.checkpoint.folder / TOKENIZER
        try:
            self._tokenizer = Tokenizer.from_file(str(file))
            torch.zeros(1, device=device)
        except Exception as error:  # tokenizers and torch raise plain Exception or AssertionError
            culprit = file if self._tokenizer is None else f"device {device!r}"
            raise WorkerError(f"{culprit} cannot be used: {in_words(error)}") from error
        self._tokenizer.no_truncation()
        self._tokenizer.no_padding()
        network = load_network(
            self.checkpoint, device=device, dtype=getattr(torch, name), adapter=self._adapter
        )
        quantise(network, self._quantise)
        self.network = network
        if self._files is not None:
            from vla_zenoh_model_openvla.chunk_head import load_chunk_head

            self._head = load_chunk_head(self._files, network, self._chunk)
        self._must_see()

    def _must_see(self) -> None:
        """Two images must give different features: with newer libraries the published code sees
        none."""
        import torch

        noise = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
        with torch.inference_mode():
            eyes = self.network.vision_backbone
            gray, mixed = (eyes(self._pixels(p)) for p in (np.full_like(noise, 128), noise))
            if not torch.isfinite(mixed).all():
                raise WorkerError("the image encoders compute NaN or infinity")
            if torch.equal(gray, mixed):
                raise WorkerError("the image encoders answer alike whatever the image is")
        # The first inference of a process costs much more than the others.
        ids, pictures = self.ids("stand still"), [self._pixels(noise)] * len(self._cameras)
        states = [[0.0] * len(self._state_range.low)] if self._state_range else None
        self._answers([ids], pictures, states)

    def ids(self, task: str) -> list[int]:
        """Tokens of the prompt for a task in a person's words.

        Raises:
            SpecError: more than the model reads.
        """
        text = prompt_text(self._template, task)
        config = self.network.language_model.config
        found = self._tokenizer.encode(text, add_special_tokens=True).ids
        if not found or found[0] != config.bos_token_id:
            found = [config.bos_token_id, *found]
        ids = prompt_tokens(found)
        patches = self.network.vision_backbone.patches * len(self._cameras)
        places = AXES * self._chunk + 2
        if len(ids) + patches + places > config.max_position_embeddings:
            raise SpecError(f"a prompt of {len(ids)} tokens is more than the model reads")
        return ids

    def _pixels(self, picture: Any) -> Any:
        return self.network.vision_backbone.look(
            picture, device=self.network.device, dtype=self.network.dtype
        )

    def infer(self, observation: Observation) -> ActionSteps:
        """One step for the newest picture; OFT: a chunk.

        Raises:
            SpecError: the model's answer is not an action.
            WorkerError: it computes NaN.
        """
        return self.infer_batch([observation])[0]

    def infer_batch(self, observations: Sequence[Observation]) -> list[ActionSteps]:
        """What `infer` answers to each, by one pass for all.

        Raises:
            SpecError, WorkerError: as `infer`.
        """
        seen = [
            {name: trained_form(one.images[name], crop=self._crop) for name in self._cameras}
            for one in observations
        ]
        prompts = [self.ids(one.prompt) for one in observations]
        states = None
        if self._state_range is not None and self._state is not None:
            measured = [self._state.encode(one) for one in observations]
            states = [self._state_range.shrink(each).tolist() for each in measured]
        pixels = [self._stacked([one[name] for one in seen]) for name in self._cameras]
        answers = self._answers(prompts, pixels, states)
        steps: list[ActionSteps] = []
        for index, (one, ids, answer) in enumerate(
            zip(observations, prompts, answers, strict=True)
        ):
            raw: dict[str, Any] = {
                "prompt": prompt_text(self._template, one.prompt),
                "prompt_tokens": ids,
            }
            if states is not None:
                raw["state"] = states[index]
            if self._head is None:
                raw["action_tokens"] = answer
                answer = [self.bins.decode(answer)]
            normalised = np.asarray(answer, np.float64)
            raw["normalised"] = normalised.tolist()
            rows = self._range.expand(normalised)[: self.spec.action.horizon]
            if self.spec.action.gripper == "open_fraction":
                rows[:, -1] = np.clip(rows[:, -1], 0.0, 1.0)
            steps.append(ActionSteps(self._meaning.steps(rows), raw=raw, pictures=seen[index]))
        return steps

    def _stacked(self, pictures: Sequence[Any]) -> list[Any]:
        """One camera's images of all robots, for each encoder."""
        import torch

        looked = zip(*(self._pixels(picture) for picture in pictures), strict=True)
        return [torch.cat(of_encoder) for of_encoder in looked]

    def _answers(
        self, prompts: list[list[int]], pixels: list[list[Any]], states: list[list[float]] | None
    ) -> Any:
        """Tokens of a step of each; OFT: (n, steps, 7) numbers."""
        if self._head is None:
            return self.network.act_all(prompts, pixels[0], AXES)
        return self._head.act_all(self.network, prompts, pixels, states).cpu().numpy()
