"""Entry of ``vla-zenoh``. The words that drive a robot start at once; all others go by Typer.

Typer, Rich and the profile's schema take half a second to load, in which an arm that shall stop
moves on.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from vla_zenoh.cli.words import WORDS, parse

EXTRA_OF = {
    "pinocchio": "control",
    "ruckig": "control",
    "mujoco": "sim",
    "matplotlib": "sim",
    "av": "sim",
    "mcap": "record",
    "plotly": "record",
    "jinja2": "record",
    "rosbags": "record",
    "rerun": "view",
}
"""Module -> extra that brings it, for the error of a missing import."""


def main() -> None:
    """Run the command line. Errors of this package become one line and exit code 1."""
    try:
        _chosen(sys.argv[1:])()
    except ImportError as error:
        extra = EXTRA_OF.get((error.name or "").partition(".")[0])
        if extra is None and ".so" not in str(error):
            raise
        from vla_zenoh.cli.plain import fail
        from vla_zenoh.errors import how_to_install

        fail(
            f"{error}; install it with: {how_to_install(extra)}"
            if extra
            else f"{error}; `vla-zenoh doctor` names the system package"
        )
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        from vla_zenoh.errors import VlaZenohError

        if not isinstance(error, VlaZenohError):
            raise
        from vla_zenoh.cli.plain import fail

        fail(str(error))


def _chosen(words: Sequence[str]) -> Callable[[], None]:
    parsed = parse(words)
    if parsed is None:
        from vla_zenoh.cli.main import app

        return app
    import zenoh

    from vla_zenoh.cli.target import RobotTarget

    zenoh.init_log_from_env_or("off")  # as main.py does
    name, arguments, target = parsed
    function = getattr(import_module(WORDS[name].module), name)
    return lambda: function(target=RobotTarget(**target), **arguments)
