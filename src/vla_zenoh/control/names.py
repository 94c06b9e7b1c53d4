"""Names that nodes know each other by."""

from __future__ import annotations


def worker_node(worker: str) -> str:
    """Node name of a worker."""
    return f"worker-{worker}"
