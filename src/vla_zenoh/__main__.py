"""``python -m vla_zenoh``: the same as ``vla-zenoh``."""

from vla_zenoh.runtime.parent_watch import die_with_parent

if __name__ == "__main__":
    die_with_parent()  # before what a node imports, which takes its time

    from vla_zenoh.cli.entry import main

    main()
