"""Live and recorded runs in Rerun."""

from __future__ import annotations
