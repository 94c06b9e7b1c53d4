"""Compares vla-zenoh with other ways of serving a policy. Not part of the wheel."""
