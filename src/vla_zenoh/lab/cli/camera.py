"""vla-zenoh camera list: the cameras of this computer, and what each of them shows."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.output import console, new_table
from vla_zenoh.errors import MissingExtraError, VlaZenohError, in_words
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.cli.output_path import ForceOption, if_wanted, output_folder
from vla_zenoh.nodes.camera.node import make_source
from vla_zenoh.opencv import cv2
from vla_zenoh.plugins import CAMERAS, CameraPlugin, FoundCamera, load_all
from vla_zenoh.profile.schema import CameraProfile

WARM_UP = 15
"""Images until exposure has settled."""


@options
def camera_list(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for a picture of each camera.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """List the cameras of this computer by what stands for them in a profile.

    A serial number, or a name in /dev/v4l/by-id, stays with a camera; /dev/videoN may be another
    one after a restart. With --output each is opened: stop the nodes that use them first.
    """
    with if_wanted(output_folder, output, force=force) as folder:
        found = [each._asdict() for each in connected_cameras(load_all(CAMERAS).values())]
        if folder is not None:
            for row in found:
                with progress(f"a picture of {row['source']}"):
                    row |= _picture(row["source"], folder)
    if as_json:
        print_json(found)
        return
    if not found:
        console().print("no cameras")
        return
    columns = ["source", "name", "device"] + ([] if output is None else ["picture"])
    table = new_table(*columns)
    for row in found:
        table.add_row(*(str(row.get(name, "")) for name in columns))
    console().print(table)


def connected_cameras(sources: Iterable[CameraPlugin]) -> list[FoundCamera]:
    """Cameras of every source that can list them; those of a maker by its own library, if here."""
    found: list[tuple[str, FoundCamera]] = []
    makers: set[str] = set()
    for source in sources:
        try:
            found += [(source.maker, camera) for camera in source.connected()]
        except MissingExtraError:
            continue
        if source.maker:
            makers.add(source.maker)
    return [
        camera
        for maker, camera in found
        if maker or not any(other in camera.name for other in makers)
    ]


def _picture(source: str, folder: Path) -> dict[str, Any]:
    """Path and size of a picture, or why there is none."""
    camera = make_source(CameraProfile(source=source))
    try:
        camera.open()
        stop = threading.Event()
        image = None
        for _ in range(WARM_UP):
            if camera.grab(stop) is not None:
                image = camera.retrieve()
        if image is None:
            return {"picture": "none: no image could be decoded"}
        path = folder / f"{re.sub(r'[^A-Za-z0-9.-]+', '_', source)}.jpg"
        if not cv2.imwrite(str(path), image):
            return {"picture": f"none: {path} cannot be written"}
        height, width = image.shape[:2]
        return {"picture": f"{path.name} ({width}x{height})"}
    except VlaZenohError as error:
        return {"picture": f"none: {in_words(error)}"}
    finally:
        camera.close()
