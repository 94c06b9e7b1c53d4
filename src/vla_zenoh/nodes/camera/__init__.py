"""Where pictures come from, and the way they go out. One kind of source a file."""
