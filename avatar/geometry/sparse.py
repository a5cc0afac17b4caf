"""Sparse weighted gathers from the rows of a mesh or a hierarchy, and their transposes, which scatter back.

Autograd's own backward pass of a gather adds slowly on the CPU and in an order of chance on CUDA. The transpose of a
table is a table again, so both directions are the same fast, repeatable sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from avatar.checks import check_shape


@dataclass(frozen=True)
class SparseRows:
    """A sparse linear map on ``rows`` rows: result ``i`` adds up ``weights[j] * values[ids[j]]`` from ``starts[i]`` on.

    ``ids (L,)`` int64, ``starts (R,)`` int64, one sum after the other, ``weights (L,)`` or None where all are one.
    """

    ids: Tensor
    starts: Tensor
    weights: Tensor | None
    rows: int

    @classmethod
    def of_table(cls, ids: Tensor, rows: int, weights: Tensor | None = None) -> SparseRows:
        """SparseRows of one size: ``ids (R, K)`` and weights alike."""
        dims = check_shape("ids", ids, "R K")
        if weights is not None:
            check_shape("weights", weights, "R K", **dims)
            weights = weights.flatten()
        starts = torch.arange(0, ids.numel(), dims["K"], device=ids.device)
        return cls(ids.flatten(), starts, weights, rows)

    def transpose(self) -> SparseRows:
        """The transposed map: it takes a row for every sum and has a sum for every row."""
        order = self.ids.argsort(stable=True)
        places = torch.arange(self.rows, device=order.device)
        members = torch.searchsorted(self.starts, order, right=True) - 1
        weights = None if self.weights is None else self.weights[order]
        return SparseRows(members, torch.searchsorted(self.ids[order], places), weights, len(self.starts))


class _GatherSum(torch.autograd.Function):
    """The sum with its transpose as backward pass; differentiable as often as one likes."""

    @staticmethod
    def forward(context: Any, values: Tensor, sparse: SparseRows, back: SparseRows | None) -> Tensor:
        context.sparse, context.back = sparse, back
        frames, rows, channels = values.shape
        each = torch.arange(frames, device=values.device)[:, None]
        weights = None if sparse.weights is None else sparse.weights.to(values.dtype).repeat(frames)
        summed = embedding_bag(
            (sparse.ids + each * rows).flatten(),
            values.reshape(-1, channels),
            (sparse.starts + each * len(sparse.ids)).flatten(),
            mode="sum",
            per_sample_weights=weights,
        )
        return summed.view(frames, len(sparse.starts), channels)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        back = context.back or context.sparse.transpose()
        return _GatherSum.apply(gradient, back, context.sparse), None, None


def gather_sum(values: Tensor, sparse: SparseRows, back: SparseRows | None = None) -> Tensor:
    """Weighted sums of rows, ``(..., V, C)`` to ``(..., R, C)``; differentiable in the values.

    ``back`` is ``sparse.transpose()``, which the backward pass makes where it is not given.
    """
    check_shape("values", values, "... V C", V=sparse.rows)
    summed = _GatherSum.apply(values.reshape(-1, *values.shape[-2:]), sparse, back)
    return summed.view(*values.shape[:-2], *summed.shape[-2:])


def pick(values: Tensor, ids: Tensor) -> Tensor:
    """Entries of the first dimension, ``(M, ...)`` by ``(N,)`` indices to ``(N, ...)``: ``values[ids]``, repeatable.

    The backward pass of ``values[ids]`` itself adds in an order of chance where an entry is picked more than once.
    """
    check_shape("ids", ids, "N")
    sparse = SparseRows.of_table(ids[:, None], len(values))
    return gather_sum(values.reshape(len(values), -1), sparse).view(len(ids), *values.shape[1:])


class _GatherRows(torch.autograd.Function):
    """Rows of each array of a batch by its own indices; gradients are added in the order of the indices."""

    @staticmethod
    def forward(context: Any, values: Tensor, ids: Tensor) -> Tensor:
        context.save_for_backward(ids)
        context.rows = values.shape[1]
        return values.gather(1, ids.unsqueeze(-1).expand(-1, -1, values.shape[-1]))

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (ids,), (frames, _, channels), rows = context.saved_tensors, gradient.shape, context.rows
        if gradient.device.type == "cpu":  # adds in order as well, a tenth of the sort's time
            zeros = gradient.new_zeros(frames, rows, channels)
            return zeros.scatter_add(1, ids.unsqueeze(-1).expand_as(gradient), gradient), None
        each = rows * torch.arange(frames, device=ids.device)[:, None]
        back = SparseRows.of_table((ids + each).reshape(-1, 1), frames * rows).transpose()
        return gather_sum(gradient.reshape(-1, channels), back).view(frames, rows, channels), None


def gather_rows(values: Tensor, ids: Tensor) -> Tensor:
    """Rows of ``(B, M, C)`` picked by ``(B, N)`` indices: ``(B, N, C)``; repeatable, backward pass included."""
    check_shape("ids", ids, "B N", B=check_shape("values", values, "B M C")["B"])
    return _GatherRows.apply(values, ids)
