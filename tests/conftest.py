"""What all tests share."""

from __future__ import annotations

import os

from hypothesis import settings

# Machines that run tests are slow now and then: time per example says nothing about the code.
settings.register_profile("default", deadline=None)
settings.register_profile("thorough", deadline=None, max_examples=2000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))
