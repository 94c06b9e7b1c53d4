"""``python -m vla_zenoh``: the same as ``vla-zenoh``."""

import os

if __name__ == "__main__":
    if "VLA_ZENOH_PARENT" in os.environ:  # `parent_watch.PARENT_VARIABLE`; a stop has none
        from vla_zenoh.runtime.parent_watch import die_with_parent

        die_with_parent()  # before the imports of a node, which take long

    from vla_zenoh.cli.entry import main

    main()
