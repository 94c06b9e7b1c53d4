"""Why a calibration cannot be made."""

from __future__ import annotations

from vla_zenoh.errors import VlaZenohError


class CalibrationError(VlaZenohError):
    """A calibration that its images and poses do not determine, or contradict."""
