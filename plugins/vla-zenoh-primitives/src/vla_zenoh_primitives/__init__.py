"""The node of the guarded primitives, a worker whose chunks go to one target, and its clients."""
