"""What a calibration found, as files, and as keys of a profile."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.profile.schema import CameraMount, camera_plugin
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.hand_eye import HandEye
from vla_zenoh_calibrate.lens import Lens
from vla_zenoh_calibrate.view import inverse


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration of one camera.

    Args:
        camera: its name in the profile.
        source: of it, there.
        views: how many there were.
        lens: of images of the calibration's size.
        quality: of that lens; None: it was known.
        place: hand-eye; None: only the lens.
        mount: for the profile, None as `place`.
    """

    camera: str
    source: str
    views: int
    lens: Intrinsics
    quality: Lens | None
    place: HandEye | None
    mount: CameraMount | None

    @property
    def lens_name(self) -> str:
        """Of the file with the lens."""
        return f"{self.camera}_lens.yaml"

    @property
    def has_lens(self) -> bool:
        """Whether the profile's camera takes the lens: it is new, and the source has one."""
        return self.quality is not None and camera_plugin(self.source).has_lens

    def keys(self) -> dict[str, Any]:
        """Keys below ``cameras.NAME`` of the profile."""
        out: dict[str, Any] = {}
        if self.has_lens:
            out["intrinsics"] = self.lens_name
        if self.mount is not None:
            out["mount"] = {
                "frame": self.mount.frame,
                "link": self.mount.link,
                "position_m": [round(value, 6) for value in self.mount.position_m],
                "rpy_rad": [round(value, 6) for value in self.mount.rpy_rad],
            }
        return out

    def fragment(self) -> str:
        """Those keys as YAML of a profile."""
        camera = yaml.safe_dump({"cameras": {self.camera: self.keys()}}, sort_keys=False)
        return f"# {self.summary()}\n{camera}"

    def lens_file(self) -> str:
        """The file that ``cameras.NAME.intrinsics`` names."""
        lens = self.lens
        values = {
            "width": lens.width,
            "height": lens.height,
            **{
                name: round(getattr(lens, name), 4) for name in ("fx_px", "fy_px", "cx_px", "cy_px")
            },
            "distortion": [round(value, 7) for value in lens.distortion],
        }
        return f"# {self.summary()}\n{yaml.safe_dump(values, sort_keys=False)}"

    def summary(self) -> str:
        """One line: of what and how good."""
        size = f"{self.lens.width}x{self.lens.height}"
        said = f"Camera {self.camera}, images of {size}, {self.views} views"
        if self.quality is not None:
            said += f"; lens {self.quality.rms_px:.2f} px"
        if (place := self.place) is not None:
            said += (
                f"; place {place.spread_m * 1e3:.2f} mm and {place.spread_rad * 1e3:.2f} mrad "
                "(standard deviation)"
            )
        return said

    def report(self) -> dict[str, Any]:
        """All numbers, for JSON; lengths in m and px, angles in rad."""
        lens = self.lens
        out: dict[str, Any] = {
            "camera": self.camera,
            "views": self.views,
            "lens": {"width": lens.width, "height": lens.height, **lens.shown()},
            "profile": {"cameras": {self.camera: self.keys()}},
        }
        if (quality := self.quality) is not None:
            out["lens_quality"] = {
                "rms_px": quality.rms_px,
                "worst_view_px": quality.worst_px,
                "focal_sd_px": quality.focal_sd_px,
                "centre_sd_px": quality.centre_sd_px,
            }
        if (place := self.place) is not None:
            out["place"] = {
                "eye": place.eye,
                "rms_px": place.rms_px,
                "worst_view_px": place.worst_px,
                "worst_view": place.worst + 1,
                "rms_m": place.rms_m,
                "rms_rad": place.rms_rad,
                "spread_m": place.spread_m,
                "spread_rad": place.spread_rad,
                "square_m": place.square_m,
            }
        return out


def mount_of(place: HandEye, link: FloatArray, name: str, frame: str) -> CameraMount:
    """The mount of a profile.

    Args:
        link: (4, 4) pose of the link in what `place` is in: the TCP, or the base.
        name: of the link.
        frame: of the camera.
    """
    pose = inverse(link) @ place.camera
    x, y, z = pose[:3, 3].tolist()
    return CameraMount(frame=frame, link=name, position_m=(x, y, z), rpy_rad=rpy_of(pose[:3, :3]))


def rpy_of(rotation: FloatArray) -> tuple[float, float, float]:
    """Extrinsic x, y, z (rad) of a rotation: the inverse of `rotation_from_rpy`."""
    pitch = float(np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0])))
    if np.cos(pitch) < 1e-9:  # only the sum of both turns counts
        return 0.0, pitch, float(np.arctan2(-rotation[0, 1], rotation[1, 1]))
    roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
    return roll, pitch, float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def write_files(folder: Path, found: Calibration) -> None:
    """The fragment of the profile and, if it is new, the lens."""
    (folder / "profile.yaml").write_text(found.fragment(), "utf-8")
    if found.quality is not None:
        (folder / found.lens_name).write_text(found.lens_file(), "utf-8")
