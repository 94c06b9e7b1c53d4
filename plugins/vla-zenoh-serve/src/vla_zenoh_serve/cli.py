"""vla-zenoh serve policy: a model for clients of openpi."""

from __future__ import annotations

import logging
import os
import threading
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ModelOptions,
    ProfileOption,
    bind_address,
    effective_profile,
    not_empty,
    options,
)
from vla_zenoh.cli.output import console
from vla_zenoh.lab.cli.loopback import require_loopback
from vla_zenoh.plugins import how_to_repeat
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.runtime.environments import run_in_own_environment
from vla_zenoh.runtime.process import stop_on_signals
from vla_zenoh_serve import openpi_server


@options
def serve(
    worker: Annotated[
        str,
        typer.Option(
            "--worker", "-w", help="A worker of the profile, name of a model, or path to one."
        ),
    ],
    model: ModelOptions,
    profile: ProfileOption = DEFAULT_PROFILE,
    names: Annotated[
        str, typer.Option("--map", help="Other names, as observation/image=camera:front,...")
    ] = "",
    host: Annotated[
        str,
        typer.Option(
            parser=bind_address, help="Address to listen on; a network's only with --api-key."
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="0: any free one.")
    ] = openpi_server.PORT,
    api_key: Annotated[
        str | None,
        typer.Option(
            envvar="VLA_ZENOH_API_KEY", parser=not_empty, help="Key that clients must send."
        ),
    ] = None,
) -> None:
    """Serve a model of ours to clients of openpi."""
    loaded = effective_profile(profile)
    if api_key is None:
        require_loopback(
            loaded,
            "--host",
            host,
            "use this model without a key",
            "give --api-key KEY (VLA_ZENOH_API_KEY; not encrypted), or leave it out and "
            f"type on the other computer `ssh -L {port}:127.0.0.1:{port} THIS_COMPUTER`",
        )
    chosen = model.choose(loaded, worker)
    ours = how_to_repeat("vla-zenoh-serve")
    run_in_own_environment(chosen.model, model.python, extra="control", packages=ours)
    from vla_zenoh_serve.policy_server import PolicyServer
    from vla_zenoh_serve.served_policy import make_served_policy

    policy = make_policy(chosen.model, chosen.options, profile=profile)
    offer = make_served_policy(policy, names, loaded)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    getattr(policy, "load", lambda: None)()
    stop = stop_on_signals()
    server = PolicyServer(offer, host, port, api_key or "")
    threading.Thread(target=server.serve_forever, daemon=True).start()
    console().print(f"{chosen.name} for openpi's clients at ws://{host}:{server.port}")
    for name, what in offer.described().items():
        console().print(f"  {name}: {what}", highlight=False)
    stop.wait()
    server.stop()
    told = {"answered": server.tally.answered, **server.tally.refused}
    console().print(", ".join(f"{name} {count}" for name, count in told.items()), highlight=False)
    os._exit(0)  # threads of a model's library may keep the process alive
