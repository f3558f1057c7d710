"""The number of threads for this process; not in `compute.py`, which loads PyTorch when it is imported."""

import math
import os
from contextlib import suppress
from pathlib import Path

LIMIT = Path("/sys/fs/cgroup/cpu.max")  # of a container, as by `docker run --cpus 2`: "200000 100000", or "max 100000"


def threads() -> int:
    """Return the number of threads: the cores that this process may use, shared with this machine's other ranks."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # not in a container, or in one without a limit
        time, period = map(int, LIMIT.read_text(encoding="ascii").split())
        cores = min(cores, math.ceil(time / period))
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
