"""Maps the declarations of a LeRobot directory to cameras, state and actions of this robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vla_zenoh_policy_servers.field_mapping import FieldSource, read_map, read_size
from vla_zenoh_policy_servers.state_vector import read_state

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.policy.options import (
    one_of,
    read_json,
    whole_number,
)

CONFIG, WEIGHTS = "config.json", "model.safetensors"
ADAPTER = "adapter_config.json"
PICKLES = frozenset({".bin", ".pt", ".pth", ".ckpt", ".pkl"})
PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
STATE, ACTION, PICTURE = "observation.state", "action", "observation.image"
EMPTY = "observation.images.empty_camera_"
"""Images without a camera, which LeRobot creates itself."""
MAX_STEPS = 1000
WITHOUT_WORDS = frozenset({"act", "diffusion", "tdmpc", "vqbet"})
"""Policies that read no prompt."""
GO_WITHOUT = frozenset({"pi0", "pi05", "smolvla", "xvla"})
"""Policies that accept missing images."""
OF_BASE = frozenset({"pi0", "pi05", "smolvla"})
"""After fine-tuning, their config still has the images and the state of the published weights,
whatever the data had; they resize images themselves."""
RTC = frozenset({"pi0", "pi05", "smolvla"})
"""Policies that LeRobot conditions on the steps in execution."""
NOISY = frozenset({"pi0", "pi05", "smolvla"})
"""Policies that take the noise from which their flow begins."""
BATCHED = NOISY | {"act"}
"""Policies of LeRobot whose chunk depends on nothing but the observation and that noise, so that
one pass answers several robots as one pass for each does."""
REMOTE_CODE = frozenset({"gaussian_actor", "groot", "pi0_fast"})
"""LeRobot runs code from a model hub for these."""


def read_config(folder: Path) -> dict[str, Any]:
    """The config of a policy directory.

    Raises:
        WorkerError: not a policy, or of a kind that is not supported.
    """
    config = read_json(folder / CONFIG)
    if not isinstance(config.get("type"), str):
        raise WorkerError(f"{folder / 'config.json'} has no type; it is not a LeRobot policy")
    if (folder / ADAPTER).is_file() and not (folder / WEIGHTS).is_file():
        raise WorkerError(f"{folder} {_how_to_merge(folder)}")
    if config["type"] in REMOTE_CODE:
        raise WorkerError(
            f"{folder} is a {config['type']!r}, for which LeRobot runs code from a model hub; "
            "such policies are not loaded"
        )
    return config


def _how_to_merge(folder: Path) -> str:
    """What to do with an adapter (LoRA), which `use_peft` of a config alone is not: merged weights
    keep it."""
    base = read_json(folder / ADAPTER).get("base_model_name_or_path") or "BASE"
    return (
        f"has an adapter (LoRA), and not the weights of {base}, which it changes. Merge both with "
        "peft: PeftModel.from_pretrained(POLICY, FOLDER).merge_and_unload().save_pretrained(MERGED)"
        f", where POLICY is {base} loaded by LeRobot; copy the files of {PIPELINES[0]} and "
        f"{PIPELINES[1]} to MERGED and give checkpoint=MERGED"
    )


def check_weights(folder: Path) -> None:
    """Raise a `WorkerError` that says what to do where a folder has no weights to load."""
    if (folder / WEIGHTS).is_file():
        return
    others = sorted(path.name for path in folder.glob("*") if path.suffix in PICKLES)
    if others:
        raise WorkerError(
            f"{folder} has no {WEIGHTS}, but {', '.join(others[:3])}: pickles are not loaded, as "
            "they can run any code; save the policy with LeRobot's save_pretrained"
        )
    raise WorkerError(f"{folder} has no {WEIGHTS}: it is incomplete; copy or download it again")


def features(folder: Path, config: Mapping[str, Any], name: str) -> dict[str, tuple[int, ...]]:
    """Feature -> shape, of ``input_features`` or ``output_features``.

    Raises:
        WorkerError: they are missing or not in LeRobot's form.
    """
    found = config.get(name)
    try:
        return {feature: tuple(about["shape"]) for feature, about in (found or {}).items()}
    except (AttributeError, KeyError, TypeError) as error:
        raise WorkerError(f"{folder / 'config.json'}: {name} are not of LeRobot's form") from error


def pictures(
    features: Mapping[str, tuple[int, ...]], told: str, kind: str
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Camera -> its feature and (C, H, W).

    Args:
        features: of the policy.
        told: ``feature=camera:NAME,...`` if the camera's name is not the feature's last part;
            ``feature=`` leaves one out.
        kind: of policy.

    Raises:
        WorkerError: names what does not fit.
        SpecError: `told` cannot be read.
    """
    wanted = {
        name: shape
        for name, shape in features.items()
        if name.startswith(PICTURE) and not name.startswith(EMPTY)
    }
    named = read_map(told)
    strange = sorted(set(named) - set(wanted))
    if strange:
        raise WorkerError(
            f"map names {strange[0]!r}, which is not an image of the policy; "
            f"its images are: {', '.join(wanted) or 'none'} (map=FEATURE=camera:NAME,...)"
        )
    out: dict[str, tuple[str, tuple[int, ...]]] = {}
    for feature, shape in wanted.items():
        source = named.get(feature, FieldSource(camera=feature.rpartition(".")[2]))
        if source is None:
            if kind not in GO_WITHOUT:
                raise WorkerError(f"map leaves out {feature}; a policy {kind!r} needs it")
            continue
        if not source.camera:
            raise WorkerError(f"map: {feature} is a picture, so {feature}=camera:NAME")
        if source.camera in out:
            raise WorkerError(f"two images of the policy must come from camera {source.camera!r}")
        if len(shape) != 3 or shape[0] != 3:
            raise WorkerError(f"{feature} has shape {shape}; wanted three colours: (3, H, W)")
        out[source.camera] = feature, shape
    return out


def picture_size(told: str, shape: tuple[int, ...], kind: str) -> tuple[int, int] | None:
    """Width and height of an input image; None: as the camera delivers it.

    Args:
        told: WIDTHxHEIGHT, nothing, or ``auto``: that of the config, where that is the data's.
        shape: (C, H, W) of the config.
        kind: of policy.

    Raises:
        SpecError: `told` cannot be read.
    """
    if told != "auto":
        return read_size(told)
    return None if kind in OF_BASE else (shape[2], shape[1])


def state_parts(
    folder: Path,
    kind: str,
    features: Mapping[str, tuple[int, ...]],
    told: str,
    joints: Sequence[int],
) -> tuple[str, ...]:
    """Parts that make ``observation.state``, in order, see `vla_zenoh_policy_servers.state_vector`.

    Args:
        folder: of the policy.
        kind: of policy.
        features: of the policy.
        told: the parts, joined by +.
        joints: how many each arm has.

    Raises:
        WorkerError: the policy needs other inputs than images and a flat state.
        SpecError: their numbers are not as many as the policy's.
    """
    other = sorted(name for name in features if name != STATE and not name.startswith(PICTURE))
    if other:
        raise WorkerError(f"the policy needs {', '.join(other)}, which no robot here can tell")
    shape = features.get(STATE, (0,))
    if len(shape) != 1:
        raise WorkerError(f"{STATE} has shape {shape}; wanted one row of numbers")
    trained = _trained_state(folder) if kind in OF_BASE else None
    return read_state(told, trained or shape[0], *joints)


def _trained_state(folder: Path) -> int | None:
    """Numbers of the state in the statistics that it is scaled with; None: there are none."""
    pipeline = folder / PIPELINES[0]
    steps = read_json(pipeline).get("steps", []) if pipeline.is_file() else []
    files = [folder / str(step["state_file"]) for step in steps if "state_file" in step]
    if not files:
        return None
    from safetensors import SafetensorError, safe_open  # comes with LeRobot

    for file in files:
        try:
            with safe_open(str(file), framework="np") as content:
                for name in (f"{STATE}.{statistic}" for statistic in ("mean", "min", "q01")):
                    if name in content.keys():  # noqa: SIM118  # it has no __contains__
                        return content.get_slice(name).get_shape()[-1]
        except (SafetensorError, OSError) as error:
            raise WorkerError(f"{file} cannot be read: {str(error)[:200]}") from error
    return None


def arm_names(told: str, parts: Sequence[str]) -> tuple[str, ...]:
    """The robot's parts in the order of the policy's numbers; of a robot of one part ``("",)``.

    Args:
        told: their names, separated by commas; empty: in the order of the profile.
        parts: those of the profile.

    Raises:
        SpecError: `told` names others.
    """
    named = tuple(name.strip() for name in told.split(",")) if told else tuple(parts)
    if sorted(named) != sorted(parts):
        raise SpecError(
            f"parts is {told!r}; the robot's are: {', '.join(parts) or 'none, it is one arm'} "
            "(--set parts=... names each once, in the order of the policy's numbers)"
        )
    return named or ("",)


def one_by_one(config: Mapping[str, Any]) -> bool:
    """Whether a policy is asked step by step: it uses several observations, or averages chunks."""
    return config.get("n_obs_steps", 1) > 1 or config.get("temporal_ensemble_coeff") is not None


def takes_prefix(config: Mapping[str, Any], told: str) -> bool:
    """Whether the policy gets the steps in execution.

    Args:
        config: of the policy.
        told: ``on`` or ``off``.

    Raises:
        SpecError: `told` is neither.
        WorkerError: LeRobot has no real-time chunking for this policy.
    """
    one_of("rtc", told, ("on", "off"))
    if told == "on" and (config["type"] not in RTC or one_by_one(config)):
        raise WorkerError(
            f"rtc=on: LeRobot has real-time chunking for {', '.join(sorted(RTC))}, which answer "
            f"with chunks, and this is a {config['type']!r}; leave rtc out"
        )
    return told == "on"


def horizon(config: Mapping[str, Any], told: str) -> int:
    """Steps of a chunk that are sent: as set, else as many as the policy was made to execute.

    Raises:
        WorkerError: more than its chunks have.
        SpecError: no whole number.
    """
    most = config.get("chunk_size", MAX_STEPS)
    steps = whole_number("horizon", told or str(config.get("n_action_steps", most)), least=1)
    if steps > min(most, MAX_STEPS):
        raise WorkerError(f"horizon is {steps}; the policy's chunks have {most}")
    return steps


def device_step(pipeline: Path) -> bool:
    """Whether a pipeline has a step that moves tensors; rejects steps named by module.

    Raises:
        WorkerError: it cannot be read, or would import what the directory names.
    """
    if not pipeline.is_file():
        raise WorkerError(
            f"{pipeline.parent} has no {pipeline.name}: a policy from before LeRobot 0.4. In "
            "LeRobot's environment: python -m lerobot.processor.migrate_policy_normalization "
            f"--pretrained-path {pipeline.parent}; give what it writes, "
            f"checkpoint={pipeline.parent}_migrated"
        )
    steps = read_json(pipeline).get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise WorkerError(f"{pipeline}: wanted a list of steps")
    for step in steps:
        if "registry_name" not in step:
            raise WorkerError(
                f"{pipeline}: step {step.get('class')!r} is not one of LeRobot's own; "
                "code that a directory names is not run"
            )
    return any(step["registry_name"] == "device_processor" for step in steps)
