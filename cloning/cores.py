"""How many processor cores this process may use; apart from `compute` because importing that loads PyTorch."""

import os


def threads() -> int:
    """Return the number of threads for this process: its cores, shared with the other ranks on this machine.

    Where the system tells which cores the process may run on (Linux), only those count.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
