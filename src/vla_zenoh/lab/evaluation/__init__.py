"""Evaluation of recorded runs."""

from __future__ import annotations
