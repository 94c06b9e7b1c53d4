"""Other people's wires: what it takes to speak them, without a session."""
