"""Layers over points, layers in float32 whatever a network runs in, and normalisation over all ranks."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.functional import linear
from torch.nn.modules.batchnorm import _BatchNorm

from avatar.checks import AvatarError
from avatar.geometry.precision import full_precision

wide_linear = full_precision(linear)


class WideLinear(nn.Linear):
    """A linear layer in full precision: ``(..., C)`` to ``(..., C')``."""

    forward = full_precision(nn.Linear.forward)


class WideConv2d(nn.Conv2d):
    """A convolution in full precision: ``(B, C, H, W)`` to ``(B, C', H', W')``."""

    forward = full_precision(nn.Conv2d.forward)


class PointNorm(nn.BatchNorm1d):
    """Batch normalisation over every dimension but the last: ``(..., C)`` to ``(..., C)``."""

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features.flatten(0, -2)).view_as(features)


def point_mlp(
    widths: tuple[int, ...], first: type[nn.Linear] = nn.Linear, activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """Linear, normalisation, activation for each consecutive pair of widths; acts on the last dimension.

    ``first`` is the kind of the first layer: `WideLinear` where it sees positions.
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(widths):
        layers += [(nn.Linear if layers else first)(fan_in, fan_out), PointNorm(fan_out), activation()]
    return nn.Sequential(*layers)


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
    """Batch normalisation over the batches of all ranks, with the parameters and buffers of the layer it stands for.

    As nn.SyncBatchNorm on CUDA; the batch's moments follow from each rank's without cancellation (Chan's formula).
    """

    dimension = -1  # of the channels

    def _check_input_dim(self, features: Tensor) -> None:
        """Accepts any shape with channels in `dimension`."""

    def forward(self, features: Tensor) -> Tensor:
        """Normalises ``(..., C, ...)`` features; in evaluation by the running statistics."""
        rows = features.movedim(self.dimension, -1)
        flat = rows.flatten(0, -2).to(torch.promote_types(rows.dtype, torch.float32))
        if self.training:
            mean, variance, count = self.world_moments(flat)
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

    def world_moments(self, flat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, variance ``(C,)`` and number of all rows of all ranks, from this process's ``(n, C)``."""
        channels = flat.shape[1]
        local = [flat.mean(dim=0), flat.var(dim=0, correction=0), flat.new_tensor([len(flat)])]
        means, variances, counts = _GatherMoments.apply(torch.cat(local)).split([channels, channels, 1], dim=1)
        weights = counts.detach() / counts.detach().sum()
        mean = (weights * means).sum(dim=0)
        variance = (weights * (variances + (means - mean).square())).sum(dim=0)
        return mean, variance, counts.detach().sum()


def synchronize_norms(model: nn.Module, replicated: Collection[str] = ()) -> None:
    """Turns the batch normalisations of a model into `SharedNorm`s, in place; names and weights stay the same.

    Those of the ``replicated`` submodules stay as they are: every process runs them on all outfits of the step
    (`step_outfits`). Raises `AvatarError` for a kind of normalisation that it does not know.
    """
    for path, parent in list(model.named_modules()):
        if path.partition(".")[0] in replicated:
            continue
        for name, layer in parent.named_children():
            if not isinstance(layer, _BatchNorm) or isinstance(layer, SharedNorm):
                continue
            if type(layer) not in (PointNorm, nn.BatchNorm1d, nn.BatchNorm2d) or layer.running_mean is None:
                raise AvatarError(f"{type(layer).__name__}: unknown to data-parallel training. Hint: use one process.")
            shared = SharedNorm(layer.num_features, layer.eps, layer.momentum, layer.affine)
            shared.dimension = -1 if isinstance(layer, PointNorm) else 1
            shared._parameters, shared._buffers = layer._parameters, layer._buffers
            setattr(parent, name, shared.train(layer.training))
