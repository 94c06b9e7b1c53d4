"""A person as a worker: keyboard, gamepad, SpaceMouse or a leader arm."""
