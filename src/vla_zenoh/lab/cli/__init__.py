"""The lab's commands of `vla-zenoh`."""
