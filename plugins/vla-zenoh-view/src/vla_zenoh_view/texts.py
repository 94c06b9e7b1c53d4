"""Text panels: task and state, events, answers of models."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

import rerun as rr
from numpy.typing import NDArray

from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.types import Event, InferenceDebug, NodeStatus, Task
from vla_zenoh_view import paths

LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
BOUND_NS = 1_000_000_000
"""Time after its last event for which a limit counts as active."""
MAX_RAW = 600


class TextPanels:
    """Logs texts at the current time of a Rerun stream.

    Args:
        missing: why the robot itself is not shown; empty if it is.
    """

    def __init__(self, stream: rr.RecordingStream, profile_yaml: str, missing: str = "") -> None:
        self._stream, self._missing = stream, missing
        self._task: Task | None = None
        self._status: NodeStatus | None = None
        self._bounds: dict[str, tuple[int, str]] = {}
        self._now = ""
        text = f"```yaml\n{profile_yaml}\n```"
        self._document(paths.PROFILE, text, static=True)

    def _document(self, path: str, text: str, *, static: bool = False) -> None:
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._stream.log(path, document, static=static)

    # -- now ----------------------------------------------------------------------------------
    def task(self, task: Task) -> None:
        """Keep the task that the command node published."""
        self._task = task

    def status(self, status: NodeStatus) -> None:
        """Keep the status of the command node."""
        self._status = status

    def now(self, stamp_ns: int, rejected: Counter[str], dropped: int) -> None:
        """Log the current state if it has changed.

        Args:
            rejected: samples that cannot be shown, by key and reason.
            dropped: samples that came faster than they could be shown.
        """
        acting = [text for since, text in self._bounds.values() if 0 <= stamp_ns - since < BOUND_NS]
        bounds = f"- Bounds acting: {', '.join(acting) or 'none'}"
        lines = [*self._of_task(), "", bounds, *self._of_refusals()]
        if self._missing:
            lines.append(f"- The robot itself is not shown: {plain(self._missing)}")
        if rejected:
            named = ", ".join(f"{plain(why)} ({count})" for why, count in rejected.most_common(5))
            lines.append(f"- **Not shown here:** {named}")
        if dropped:
            lines.append(f"- **Left out here, too slow:** {dropped} samples")
        text = "\n".join(lines)
        if text != self._now:
            self._now = text
            self._document(paths.NOW, text)

    def _of_task(self) -> list[str]:
        task = self._task
        if task is None:
            return ["No task received from a command node."]
        state = self._status.state if self._status is not None else ""
        why = str(self._status.detail.get("why", "")) if self._status is not None else ""
        return [
            f"## {plain(task.prompt) or '(no prompt)'}",
            "",
            f"**{plain(state) or 'unknown'}**{f', {plain(why)}' if why else ''}",
            "",
            f"{plain(task.worker)} at {task.rate_hz:g} Hz, "
            f"{'active' if task.active else 'not active'}"
            f"{f', speed {task.speed_percent:g} %' if task.speed_percent < 100 else ''}",
        ]

    def _of_refusals(self) -> list[str]:
        counters = self._status.counters if self._status is not None else {}
        refused = [
            f"{plain(name.removeprefix('refused.'))} {count}"
            for name, count in sorted(counters.items())
            if name.startswith("refused.") and count
        ]
        return [f"- Refused by the command node: {', '.join(refused)}"] if refused else []

    # -- log ----------------------------------------------------------------------------------
    def event(self, node: str, stamp_ns: int, event: Event) -> None:
        if event.kind == "limit":
            self._bounds[event.what] = (stamp_ns, plain(f"{event.what} {event.why}".strip()))
        parts = [f"{node}: {event.what}"]
        if event.why:
            parts.append(event.why)
        if event.value is not None:
            limit = f", limit {event.limit:.4g}" if event.limit is not None else ""
            parts.append(f"({event.value:.4g}{limit})")
        if event.count > 1:
            parts.append(f"x{event.count}")
        level = LEVELS[event.level]
        self._stream.log(paths.below(paths.EVENTS, node), rr.TextLog(" ".join(parts), level=level))

    def setting(self, name: str, text: str) -> None:
        line = f"{name}: {text}" if text else name
        self._stream.log(f"{paths.EVENTS}/settings", rr.TextLog(line, level="INFO"))

    def answer(self, seen: InferenceDebug, spec: ModelSpec | None) -> None:
        """Log a request to a model and its answer.

        Args:
            spec: of the model; None: not received yet, its numbers have no names.
        """
        raw = json.dumps(seen.raw) if seen.raw else ""
        lines = [
            f"**{plain(seen.prompt)}**",
            "",
            f"chunk {seen.chunk_seq}, {seen.inference_ms:.1f} ms, {len(seen.steps)} steps"
            + (", the last ones" if seen.done else ""),
            "",
            _first_step(seen, spec),
            *(
                ["", f"raw `{raw if len(raw) <= MAX_RAW else f'{raw[:MAX_RAW]}...'}`"]
                if raw
                else []
            ),
        ]
        self._document(paths.answer(seen.worker), "\n".join(lines))


def _first_step(seen: InferenceDebug, spec: ModelSpec | None) -> str:
    if not len(seen.steps):
        return ""
    step = seen.steps[0]
    if spec is None or len(step) != spec.action.dimension:
        return "first step " + " ".join(f"{value:+.4f}" for value in step)
    action = spec.action
    each = [(own.part, own.action) for own in action.parts] or [("", action)]
    return "\n\n".join(_of_arm(part, own, step[action.columns(part)]) for part, own in each)


def _of_arm(part: str, action: ActionSpec, step: NDArray[Any]) -> str:
    """The numbers of one arm in a step."""
    title = f"{part} first step".strip()
    if action.space == "joint":
        arm = zip(action.joints, step.tolist(), strict=False)
        return f"{title} " + ", ".join(f"{name} {value:+.4f}" for name, value in arm)
    scale_mm = action.position_scale_m * 1e3
    rows = [f"| {title} | x | y | z |", "|---|---|---|---|"]
    per = "/s" if action.kind == "velocity" else ""
    rows.append(
        f"| mm{per} | " + " | ".join(f"{value * scale_mm:+.1f}" for value in step[:3]) + " |"
    )
    turn = [float(value) for value in step[3 : action.dimension - (action.gripper != "none")]]
    if len(turn) == 3:
        rows.append(f"| mrad{per} | " + " | ".join(f"{value * 1e3:+.1f}" for value in turn) + " |")
    text = "\n".join(rows)
    if action.gripper != "none":
        text += f"\n\ngripper {float(step[-1]):+.3f} ({action.gripper.replace('_', ' ')})"
    return text


def plain(text: str) -> str:
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+!|~" else c for c in " ".join(text.split()))
