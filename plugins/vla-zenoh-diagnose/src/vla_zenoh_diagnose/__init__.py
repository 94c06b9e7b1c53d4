"""What a model got and answered, and what travels between hosts."""
