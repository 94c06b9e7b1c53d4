"""The model ``r2c_policy``: its declaration."""

from __future__ import annotations

from pathlib import Path

from vla_zenoh.plugins import FilePlugin

POLICY = FilePlugin(file=Path(__file__).with_name("policy_model.py"))
