"""``python -m vla_zenoh``: the same as ``vla-zenoh``."""

from vla_zenoh.cli.main import app_entry

if __name__ == "__main__":
    app_entry()
