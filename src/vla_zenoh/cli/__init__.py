"""The command line of vla-zenoh. ``main.py`` lists all commands and where each is."""
