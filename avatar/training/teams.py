"""The processes of a training run that torchrun started as a team; torch is imported where there is one, not before."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from avatar.checks import AvatarError


@dataclass(frozen=True)
class Team:
    """The processes of one run: ``rank`` is this one's number, ``size`` how many there are."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes the files and talks to the user."""
        return self.rank == 0

    def share(self, batch: int) -> slice:
        """The frames of a batch that are this process's own.

        Raises:
            AvatarError: when a batch cannot be shared out evenly.
        """
        if batch % self.size:
            raise AvatarError(f"batch: expected a multiple of the {self.size} processes, got {batch}.")
        count = batch // self.size
        return slice(self.rank * count, (self.rank + 1) * count)


def current_team() -> Team:
    """The team this process has joined; alone if none."""
    dist = sys.modules.get("torch.distributed")  # who has joined a team has imported it
    if dist is not None and dist.is_available() and dist.is_initialized():
        return Team(dist.get_rank(), dist.get_world_size())
    return Team()


@contextmanager
def torchrun_team() -> Iterator[Team]:
    """Joins the team that torchrun started for the length of a ``with`` block; without torchrun there is none."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2 or "LOCAL_RANK" not in os.environ:
        yield Team()
        return
    import torch
    import torch.distributed as dist

    local, cuda = int(os.environ["LOCAL_RANK"]), torch.cuda.is_available()
    if cuda:
        if local >= torch.cuda.device_count():
            raise AvatarError(f"--nproc-per-node: expected at most {torch.cuda.device_count()} here (CUDA devices).")
        torch.cuda.set_device(local)
    dist.init_process_group("cpu:gloo,cuda:nccl" if cuda else "gloo")
    try:
        yield current_team()
    finally:
        dist.destroy_process_group()


def refuse_team(what: str) -> None:
    """Ends a job that trains in one process where torchrun started several, before they meet in one folder.

    Raises:
        AvatarError: in every process of a team.
    """
    if current_team().size > 1:
        raise AvatarError(f"{what}: expected one process, got {current_team().size}. Hint: start it without torchrun.")
