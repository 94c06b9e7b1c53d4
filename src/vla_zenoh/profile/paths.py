"""Files that a profile names are looked for beside it, wherever a node is started."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from vla_zenoh.resources import ROBOT_DATA_PREFIX, is_path

FILE_SOURCE = "file:"


def anchor(data: dict[str, Any], folder: Path) -> None:
    """Make the relative paths in `data` absolute, in place; what is no text is left to the schema.

    Args:
        data: as a profile file has it: ``robot.description``, ``arm.file``, ``ros2.messages.*``,
            those of ``models.*`` that are no names, and ``cameras.*.source`` of the form
            ``file:PATH`` are paths.
        folder: where that file is.
    """
    robot = data.get("robot")
    if isinstance(robot, dict):
        description = robot.get("description")
        if isinstance(description, str) and not description.startswith(ROBOT_DATA_PREFIX):
            robot["description"] = _below(folder, description)
    for camera in _maps(data.get("cameras")):
        source = camera.get("source")
        if isinstance(source, str) and source.startswith(FILE_SOURCE):
            path = source.removeprefix(FILE_SOURCE)
            camera["source"] = FILE_SOURCE + _below(folder, path)
    arm = data.get("arm")
    if isinstance(arm, dict) and isinstance(arm.get("file"), str):
        arm["file"] = _below(folder, arm["file"])
    models = data.get("models")
    if isinstance(models, dict):
        models.update(
            {k: _below(folder, m) for k, m in models.items() if isinstance(m, str) and is_path(m)}
        )
    ros2 = data.get("ros2")
    messages = ros2.get("messages") if isinstance(ros2, dict) else None
    if isinstance(messages, dict):
        messages.update(
            {k: _below(folder, path) for k, path in messages.items() if isinstance(path, str)}
        )


def _below(folder: Path, path: str) -> str:
    # An empty one is refused later, and ~ is the home of whoever reads the file.
    if not path or path.startswith("~"):
        return path
    return os.path.normpath(folder.absolute() / path)


def _maps(section: Any) -> list[dict[str, Any]]:
    values = section.values() if isinstance(section, dict) else ()
    return [value for value in values if isinstance(value, dict)]
