"""A worker whose model is a person: terminal, sticks, and the node around them."""
