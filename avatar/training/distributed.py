"""Data-parallel training under torchrun: every process takes its share of each batch, and all take the same step.

Gradients are averaged, the statistics of every normalisation are those of the whole batch, and what is computed once
an outfit is computed for all outfits of the step in every process; so a run gives the losses and gradients of one
process with the same batch, to rounding (with noise on the input: in distribution). NCCL serves CUDA, gloo the CPU.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from avatar.checks import AvatarError
from avatar.nn.pointnet2 import PointNorm
from avatar.training.teams import Team, current_team, refuse_team, torchrun_team

__all__ = ["current_team", "refuse_team", "torchrun_team"]


def average(tensors: list[Tensor], team: Team) -> None:
    """Replaces tensors by their mean over the team, in one exchange; every process gets the same bits."""
    if team.size == 1:
        return
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    dist.all_reduce(flat)
    flat /= team.size
    for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors])):
        tensor.copy_(mean.view_as(tensor))


def step_outfits(outfit_ids: Tensor, outfits: int, team: Team) -> Tensor:
    """The outfits in any process's share of a step, ascending: own frames' ``(B,)`` to the team's ``(O,)``."""
    seen = torch.zeros(outfits)
    seen[outfit_ids.cpu()] = 1
    average([seen], team)
    return seen.nonzero()[:, 0].to(outfit_ids.device)


def gradients_of(model: nn.Module, team: Team) -> list[Tensor]:
    """The gradients of a model, zero where only other processes have one, so that the lists of all are alike.

    Parameters that have none in any process (of a loss term that is off) are left without: Adam would count a step.
    """
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    shares = torch.tensor([float(parameter.grad is not None) for parameter in parameters])
    average([shares], team)
    found = [parameter for parameter, share in zip(parameters, shares.tolist()) if share > 0]
    for parameter in found:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    return [parameter.grad for parameter in found]


def gather(value: Any, team: Team) -> list[Any]:
    """A plain value of every process, in the order of ranks; all processes get all."""
    if team.size == 1:
        return [value]
    values: list[Any] = [None] * team.size
    dist.all_gather_object(values, value)
    return values


def from_lead(value: Any, team: Team) -> Any:
    """The leading process's value, in every process."""
    if team.size == 1:
        return value
    values = [value]
    dist.broadcast_object_list(values, src=0)
    return values[0]


class _GatherMoments(torch.autograd.Function):
    """Stacks every process's moments ``(2 C + 1,)`` to ``(P, 2 C + 1)``; a gradient goes back to where it came from."""

    @staticmethod
    def forward(context: Any, moments: Tensor) -> Tensor:
        gathered = [torch.empty_like(moments) for _ in range(dist.get_world_size())]
        dist.all_gather(gathered, moments.contiguous())
        return torch.stack(gathered)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> Tensor:
        gradient = gradient.contiguous().clone()
        dist.all_reduce(gradient)
        return gradient[dist.get_rank()]


class SharedNorm(_BatchNorm):
    """Batch normalisation over the whole team's batch, with the parameters and buffers of the layer it stands for.

    nn.SyncBatchNorm does this on CUDA alone. Each process gives count, mean and variance; the team's follow from
    them without cancellation (Chan's formula).
    """

    dimension = -1  # of the channels

    def _check_input_dim(self, features: Tensor) -> None:
        """Any shape with channels in `dimension` will do."""

    def forward(self, features: Tensor) -> Tensor:
        """Normalises ``(..., C, ...)`` features; in evaluation by the running statistics."""
        rows = features.movedim(self.dimension, -1)
        flat = rows.flatten(0, -2).to(torch.promote_types(rows.dtype, torch.float32))
        if self.training:
            mean, variance, count = self.team_moments(flat)
            with torch.no_grad():
                self.num_batches_tracked += 1
                self.running_mean.lerp_(mean, self.momentum)
                self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
        else:
            mean, variance = self.running_mean, self.running_var
        flat = (flat - mean) * (variance + self.eps).rsqrt()
        if self.affine:
            flat = flat * self.weight + self.bias
        return flat.to(features.dtype).view_as(rows).movedim(-1, self.dimension)

    def team_moments(self, flat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, variance ``(C,)`` and number of all rows of the team, from this process's ``(n, C)``."""
        channels = flat.shape[1]
        local = [flat.mean(dim=0), flat.var(dim=0, correction=0), flat.new_tensor([len(flat)])]
        means, variances, counts = _GatherMoments.apply(torch.cat(local)).split([channels, channels, 1], dim=1)
        weights = counts.detach() / counts.detach().sum()
        mean = (weights * means).sum(dim=0)
        variance = (weights * (variances + (means - mean).square())).sum(dim=0)
        return mean, variance, counts.detach().sum()


def share_norms(model: nn.Module) -> None:
    """Turns the batch normalisations of a model into `SharedNorm`s, in place; names and weights stay the same.

    Those of its ``outfit_modules`` stay as they are: every process runs these modules on all outfits of the step
    (`step_outfits`), so each has the whole batch's statistics by itself.

    Raises:
        AvatarError: for a kind of normalisation whose statistics it would not know how to share.
    """
    alike = getattr(model, "outfit_modules", ())
    for path, parent in list(model.named_modules()):
        if path.partition(".")[0] in alike:
            continue
        for name, layer in parent.named_children():
            if not isinstance(layer, _BatchNorm) or isinstance(layer, SharedNorm):
                continue
            if type(layer) not in (PointNorm, nn.BatchNorm1d, nn.BatchNorm2d) or layer.running_mean is None:
                raise AvatarError(f"{type(layer).__name__}: not known to data-parallel training. Use one process.")
            shared = SharedNorm(layer.num_features, layer.eps, layer.momentum, layer.affine)
            shared.dimension = -1 if isinstance(layer, PointNorm) else 1
            shared._parameters, shared._buffers = layer._parameters, layer._buffers
            setattr(parent, name, shared.train(layer.training))
