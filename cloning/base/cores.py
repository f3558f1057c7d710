"""The number of threads for this process; not in `compute.py`, which loads PyTorch when it is imported."""

import os


def threads() -> int:
    """Return the number of threads for this process: its cores, shared with the other ranks on this machine.

    On Linux, only the cores on which the process may run are counted.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
