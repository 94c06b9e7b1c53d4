"""The systemd unit that runs ``vla-zenoh up`` from boot on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

STOP_S = 15
"""`up` brakes the arm and stops its nodes in 3 s; one that hangs is killed after this."""
RT_PRIORITY = 50
"""Highest real-time priority that nodes of an arm may request."""

UNIT = """\
[Unit]
Description=vla-zenoh: {what}
Wants=network-online.target
After=network-online.target

[Service]
Type=exec
User={user}
{environment}ExecStart={command}
# The first signal goes to `up` alone: it brakes the arm, then ends every node.
KillMode=mixed
KillSignal=SIGTERM
TimeoutStopSec={stop_s}
Restart=on-failure
RestartSec=5
LimitRTPRIO={priority}
LimitMEMLOCK=infinity
NoNewPrivileges=yes

[Install]
WantedBy=multi-user.target
"""


def systemd_unit(
    what: str, command: Sequence[str], user: str, environment: Mapping[str, str]
) -> str:
    """Text of the unit, described by `what`, of a command with an absolute path.

    Raises:
        ValueError: a word contains characters that no unit can hold.
    """
    set_here = (_quoted(f"{name}={value}") for name, value in environment.items())
    return UNIT.format(
        what=_line(what),
        user=_line(user),
        environment="".join(f"Environment={each}\n" for each in set_here),
        command=" ".join(_quoted(word.replace("$", "$$")) for word in command),
        stop_s=STOP_S,
        priority=RT_PRIORITY,
    )


def _line(text: str) -> str:
    """Text without specifiers (systemd.unit(5))."""
    if not text.isprintable():
        raise ValueError(f"{text!r} has characters that a systemd unit cannot hold")
    return text.replace("%", "%%")


def _quoted(word: str) -> str:
    """A word as systemd.syntax(7) quotes it."""
    escaped = _line(word).replace("\\", "\\\\").replace('"', '\\"')
    return escaped if escaped and not set(escaped) & set(" \t\"'\\;") else f'"{escaped}"'
