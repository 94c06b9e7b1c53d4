"""One file a topic type: what it says, or how it is written."""
