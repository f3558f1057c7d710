"""The number of threads for this process; not in `compute.py`, which loads PyTorch when it is imported."""

import os


def threads() -> int:
    """Return the number of threads: the cores that this process may use, shared with this machine's other ranks."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
