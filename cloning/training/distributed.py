"""The processes that torchrun started for a run, each with its share of every batch.

Without torchrun there is one process, of rank 0.
"""

import os
import sys
from collections.abc import Callable
from typing import TypeVar, cast

import torch
import torch.distributed as dist

from cloning.base.errors import UserError
from cloning.network.compute import choose_device

Result = TypeVar("Result")


def rank() -> int:
    """Return this process's number; rank 0 reads the recordings, prints, and writes the files."""
    return dist.get_rank() if dist.is_initialized() else 0


def world() -> int:
    """Return the number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def join_processes(device_name: str) -> None:
    """Join the other processes, if torchrun started this one."""
    if "RANK" not in os.environ:
        return
    device = choose_device(device_name)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")


class FirstRankFailed(UserError):
    """The error of rank 0 on the other ranks; rank 0 reports it."""


def from_first_rank(make: Callable[[], Result]) -> Result:
    """Call `make` on rank 0 and return its result on every rank.

    Raises its UserError or OSError on rank 0, FirstRankFailed on the others.
    """
    outcome: list[Result | UserError | OSError | None] = [None]
    if rank() == 0:
        try:
            outcome = [make()]
        except (UserError, OSError) as error:
            outcome = [error]
    if dist.is_initialized():
        dist.broadcast_object_list(outcome)
    if isinstance(outcome[0], (UserError, OSError)):
        raise outcome[0] if rank() == 0 else FirstRankFailed
    return cast(Result, outcome[0])


def summed(values: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Return the sum of the values of all processes."""
    if dist.is_initialized():
        values = values.to(device)
        dist.all_reduce(values)
    return values


def leave_processes(status: int) -> int:
    """Return the exit status; if there are other processes, leave them and exit with it at once."""
    if dist.is_initialized():
        dist.destroy_process_group()
        # No normal exit: if a thread of gloo frees its last tensor while Python shuts down, the process aborts.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status
