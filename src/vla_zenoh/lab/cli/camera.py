"""vla-zenoh camera list: the cameras of this computer, and what each of them shows."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer

from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.output import console, new_table
from vla_zenoh.errors import MissingExtraError, VlaZenohError, in_words
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.cli.output_path import ForceOption, if_wanted, output_folder
from vla_zenoh.nodes.camera.node import make_source
from vla_zenoh.nodes.camera.realsense import connected, sdk
from vla_zenoh.nodes.camera.v4l2_devices import list_devices
from vla_zenoh.profile.schema import CameraProfile

WARM_UP = 15
"""Images until exposure has settled."""
MAKER = "RealSense"


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
        found = _cameras()
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


def _cameras() -> list[dict[str, Any]]:
    """RealSense cameras are listed by their own library, which gives them depth, if it is here."""
    try:
        found = _realsense()
    except MissingExtraError:
        return _v4l2()
    return found + [row for row in _v4l2() if MAKER not in row["name"]]


def _v4l2() -> list[dict[str, Any]]:
    return [
        {"source": one.source, "name": one.name, "device": str(one.path)} for one in list_devices()
    ]


def _realsense() -> list[dict[str, Any]]:
    info = sdk().camera_info
    return [
        {
            "source": f"realsense:{one.get_info(info.serial_number)}",
            "name": one.get_info(info.name),
            "device": one.get_info(info.usb_type_descriptor)
            if one.supports(info.usb_type_descriptor)
            else "",
        }
        for one in connected()
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
