"""``python -m vla_zenoh``: the same as ``vla-zenoh``."""

import os

if __name__ == "__main__":
    if "VLA_ZENOH_PARENT" in os.environ:  # `runtime.process.PARENT_VARIABLE`; a stop has none
        from vla_zenoh.runtime.process import die_with_parent

        die_with_parent()  # before the imports of a node, which take long

    from vla_zenoh.program.entry import main

    main()
