"""Zenoh sessions: the one place that opens them, and how each kind of key is carried."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

import zenoh

from vla_zenoh.errors import SessionError
from vla_zenoh.keys import Kind
from vla_zenoh.profile import SessionProfile

RETRY_S = 0.1

_DROP = zenoh.CongestionControl.DROP
_BLOCK = zenoh.CongestionControl.BLOCK
QOS: dict[Kind, dict[str, Any]] = {
    Kind.FRAME: {"congestion_control": _DROP, "priority": zenoh.Priority.DATA_LOW},
    Kind.STATE: {"congestion_control": _DROP, "priority": zenoh.Priority.INTERACTIVE_HIGH},
    Kind.CONTROL: {
        "congestion_control": _DROP,
        "priority": zenoh.Priority.REAL_TIME,
        "express": True,
    },
    Kind.ORDER: {
        "congestion_control": _BLOCK,
        "priority": zenoh.Priority.REAL_TIME,
        "express": True,
    },
    Kind.NEWS: {"congestion_control": _DROP, "priority": zenoh.Priority.DATA},
}


def config(
    profile: SessionProfile, *, mode: str | None = None, connect: tuple[str, ...] | None = None
) -> dict[str, Any]:
    """Zenoh's configuration as plain data, before it is handed to its strict parser."""
    mode = mode or profile.mode
    return {
        "mode": mode,
        "listen": {"endpoints": list(profile.listen) if mode == "router" else []},
        "connect": {
            "endpoints": [] if mode == "router" else list(connect or profile.connect),
            "timeout_ms": 0,
            "exit_on_failure": True,
            "retry": {
                "period_init_ms": 100,
                "period_max_ms": 500,
                "period_increase_factor": 2,
            },
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": mode == "peer"}},
        "transport": {
            "shared_memory": {"enabled": profile.shared_memory},
            "link": {
                "tx": {
                    "lease": profile.lease_ms,
                    "keep_alive": 4,
                    "queue": {
                        "congestion_control": {"block": {"wait_before_close": 200_000}},
                    },
                }
            },
        },
    }


def open_session(
    profile: SessionProfile,
    *,
    mode: str | None = None,
    connect: tuple[str, ...] | None = None,
    wait_s: float = 0.0,
    stop: threading.Event | None = None,
) -> zenoh.Session:
    """A session as the profile says.

    Args:
        profile: the session section.
        mode: overrides the profile's, for the router.
        connect: overrides the profile's endpoints.
        wait_s: keep trying for this long.
        stop: give up at once when it is set.

    Raises:
        SessionError: nobody answers there, or the address is taken; says what to do.
    """
    settings = config(profile, mode=mode, connect=connect)
    give_up = time.monotonic() + wait_s
    stop = stop or threading.Event()
    while True:
        try:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        except zenoh.ZError as error:
            if time.monotonic() < give_up and not stop.wait(RETRY_S):
                continue
            raise _explain(settings, error) from error


def _explain(settings: dict[str, Any], error: Exception) -> SessionError:
    if settings["mode"] == "router":
        where = ", ".join(settings["listen"]["endpoints"])
        return SessionError(
            f"the router cannot listen on {where}: {error}. Is another router or program there? "
            "`vla-zenoh doctor` tells; choose another address with --listen or session.listen"
        )
    where = ", ".join(settings["connect"]["endpoints"])
    return SessionError(
        f"no Zenoh router answers at {where}. Start one with `vla-zenoh router`, or everything "
        "with `vla-zenoh up`; another address is given with --connect or session.connect"
    )
