"""The processes that torchrun started for a run, each with its share of every batch."""

import os
import sys
from collections.abc import Callable
from typing import TypeVar, cast

import torch
import torch.distributed as dist

from cloning.base.errors import UserError
from cloning.network.compute import choose_device

Result = TypeVar("Result")


class FirstRankFailed(UserError):
    """The error of rank 0 on the other ranks; rank 0 reports it."""


class Ranks:
    """The processes of a run, one for each rank; without torchrun there is one, of rank 0.

    Rank 0 reads the recordings, prints, and writes the files.
    """

    def __init__(self, rank: int = 0, world: int = 1):
        """rank: of this process; world: number of processes; `join` finds those that torchrun started."""
        self.rank, self.world = rank, world

    @classmethod
    def join(cls, device_name: str) -> "Ranks":
        """Join the other processes, if torchrun started this one; device_name: see `choose_device`."""
        if "RANK" not in os.environ or os.environ.get("WORLD_SIZE", "1") == "1":
            return cls()
        device = choose_device(device_name)
        if device.type == "cuda":
            torch.cuda.set_device(device)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        return cls(dist.get_rank(), dist.get_world_size())

    @property
    def first(self) -> bool:
        """Whether this is the process that prints and writes."""
        return self.rank == 0

    @property
    def share(self) -> slice:
        """This process's share of anything that has one entry for each piece of work."""
        return slice(self.rank, None, self.world)

    def from_first(self, make: Callable[[], Result]) -> Result:
        """Call `make` on rank 0 and return its result on every rank.

        Raises its UserError or OSError on rank 0, FirstRankFailed on the others.
        """
        outcome: list[Result | UserError | OSError | None] = [None]
        if self.first:
            try:
                outcome = [make()]
            except (UserError, OSError) as error:
                outcome = [error]
        if self.world > 1:
            dist.broadcast_object_list(outcome)
        if isinstance(outcome[0], (UserError, OSError)):
            raise outcome[0] if self.first else FirstRankFailed
        return cast(Result, outcome[0])

    def summed(self, values: list[float], device: torch.device) -> list[float]:
        """Return the sum of each value over all processes; device: of the run."""
        if self.world == 1:
            return values
        total = torch.tensor(values, dtype=torch.float64).to(device)
        dist.all_reduce(total)
        return total.tolist()

    def leave(self, status: int) -> int:
        """Return the exit status; if there are other processes, leave them and exit with it at once."""
        if self.world > 1:
            dist.destroy_process_group()
            # No normal exit: if a thread of gloo frees its last tensor while Python shuts down, the process aborts.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
        return status
