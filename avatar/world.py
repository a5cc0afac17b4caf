"""Data-parallel processes under torchrun: ranks, shards of a batch, and the collectives that training needs.

Gradients are averaged, normalisations have the whole batch's statistics (`nn.layers`), and every process computes what
is computed once an outfit for all outfits of the step; so a run has the losses and gradients of one process with the
same batch, to rounding (with noise on the input: in distribution). Help needs no torch, so it is imported where needed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from avatar.checks import AvatarError

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True)
class World:
    """The processes of one run: ``rank`` is this one's number, ``size`` how many there are."""

    rank: int = 0
    size: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this is the process of rank 0, which writes files and messages."""
        return self.rank == 0

    def shard(self, batch: int) -> slice:
        """The frames of a batch that this process trains on; raises `AvatarError` if they cannot be divided evenly."""
        if batch % self.size:
            raise AvatarError(f"batch: expected a multiple of the {self.size} processes, got {batch}.")
        return slice(self.rank * batch // self.size, (self.rank + 1) * batch // self.size)


def current_world() -> World:
    """The process group this process has joined; a single process without one."""
    dist = sys.modules.get("torch.distributed")  # whoever has joined a group has imported it
    if dist is not None and dist.is_available() and dist.is_initialized():
        return World(dist.get_rank(), dist.get_world_size())
    return World()


@contextmanager
def torchrun_world() -> Iterator[World]:
    """The process group that torchrun started, joined for the length of a ``with`` block; one process without it."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2 or "LOCAL_RANK" not in os.environ:
        yield World()
        return
    import torch

    local, cuda = int(os.environ["LOCAL_RANK"]), torch.cuda.is_available()
    if cuda:
        if local >= torch.cuda.device_count():
            raise AvatarError(f"--nproc-per-node: expected at most {torch.cuda.device_count()} here (CUDA devices).")
        torch.cuda.set_device(local)
    torch.distributed.init_process_group("cpu:gloo,cuda:nccl" if cuda else "gloo")
    try:
        yield current_world()
    finally:
        torch.distributed.destroy_process_group()


def require_single_process(what: str) -> None:
    """Raises `AvatarError` in every process where torchrun started several, for jobs that train in one."""
    if current_world().size > 1:
        raise AvatarError(f"{what}: expected one process, got {current_world().size}. Hint: start it without torchrun.")


def average(tensors: list[Tensor], world: World) -> None:
    """Replaces tensors by their mean over all ranks, in one exchange; every process gets the same bits."""
    if world.size == 1:
        return
    import torch

    flat = torch.cat([tensor.flatten() for tensor in tensors])
    torch.distributed.all_reduce(flat)
    flat /= world.size
    for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors])):
        tensor.copy_(mean.view_as(tensor))


def step_outfits(outfit_ids: Tensor, outfits: int, world: World) -> Tensor:
    """The outfits in any process's shard of a step, ascending: own frames' ``(B,)`` to the world's ``(O,)``."""
    import torch

    seen = torch.zeros(outfits)
    seen[outfit_ids.cpu()] = 1
    average([seen], world)
    return seen.nonzero()[:, 0].to(outfit_ids.device)


def gradients_of(model: nn.Module, world: World) -> list[Tensor]:
    """The gradients of a model, zero where only other processes have one, so that all ranks have the same list.

    Parameters without a gradient in every process (of a loss term that is off) keep none: Adam would count a step.
    """
    import torch

    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    present = torch.tensor([float(parameter.grad is not None) for parameter in parameters])
    average([present], world)
    found = [parameter for parameter, share in zip(parameters, present.tolist()) if share > 0]
    for parameter in found:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    return [parameter.grad for parameter in found]


def gather(value: Any, world: World) -> list[Any]:
    """A plain value of every process, in the order of ranks; all processes get all."""
    if world.size == 1:
        return [value]
    import torch.distributed as dist

    values: list[Any] = [None] * world.size
    dist.all_gather_object(values, value)
    return values


def broadcast(value: Any, world: World) -> Any:
    """The value of rank 0, in every process."""
    if world.size == 1:
        return value
    import torch.distributed as dist

    values = [value]
    dist.broadcast_object_list(values, src=0)
    return values[0]
