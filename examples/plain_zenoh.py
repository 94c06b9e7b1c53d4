"""Drives a robot with nothing but the zenoh package: no part of vla-zenoh is imported.

    python examples/plain_zenoh.py [ENDPOINT]

Any Zenoh client in any language can do the same. Streams are msgpack maps; see docs/design.md.
"""

import sys
import time

import zenoh


def main(endpoint: str = "tcp/127.0.0.1:7447", robot: str = "vla/panda") -> None:
    """Let the arm go up for three seconds."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    with zenoh.open(config) as session:
        session.put(f"{robot}/prompt", "HARD: go up x10")
        session.put(f"{robot}/active", "true")
        time.sleep(3)
        session.put(f"{robot}/active", "false")
        for reply in session.get(f"{robot}/prompt"):  # the command node answers `get` on settings
            if reply.ok is not None:
                print("prompt:", reply.ok.payload.to_string())


if __name__ == "__main__":
    main(*sys.argv[1:])
