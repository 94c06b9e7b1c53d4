"""The program ``vla-zenoh``: its entry, and the table of all commands, of the core and the lab."""
