"""Camera sources, one kind a file (CONTRIBUTING.md says what it needs), and their publisher."""
