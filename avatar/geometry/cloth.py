"""Cloth as a triangle mesh: edges and hinges, and what stretching, bending and contact cost.

Every measure is a mean, so that its weight does not depend on the resolution, and differentiable in the vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, relu

from avatar.geometry.neighbours import k_nearest, nearest
from avatar.geometry.sparse import SparseRows, gather_rows, gather_sum
from avatar.geometry.surface import vertex_normals
from avatar.records import Tensors


@dataclass(frozen=True)
class ClothMesh(Tensors):
    """Topology of a cloth mesh of V vertices."""

    faces: Tensor  # (F, 3)
    edges: Tensor  # (E, 2)
    hinges: Tensor  # (H, 4): the ends of an edge with two faces, then their corners off it

    @classmethod
    def of_faces(cls, faces: Tensor) -> ClothMesh:
        """The edges and hinges of faces ``(F, 3)``; edges with more than two faces bend between the first two."""
        corners = faces.numpy()
        directed = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
        opposite = np.roll(corners, -2, axis=1).reshape(-1)
        ends, owner = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
        order = np.argsort(owner.reshape(-1), kind="stable")
        starts = np.searchsorted(owner.reshape(-1)[order], np.arange(len(ends) + 1))
        double = np.diff(starts) > 1
        first, second = order[starts[:-1][double]], order[starts[:-1][double] + 1]
        hinges = np.column_stack([directed[first], opposite[first], opposite[second]])
        return cls(faces, torch.from_numpy(ends), torch.from_numpy(hinges))

    def edge_lengths(self, vertices: Tensor) -> Tensor:
        """``(B, V, 3)`` to ``(B, E)``, metres."""
        start, end = (gather_rows(vertices, self.edges[:, place].expand(len(vertices), -1)) for place in (0, 1))
        return (end - start).norm(dim=-1)

    def angles(self, vertices: Tensor) -> Tensor:
        """Dihedral angles of the hinges, ``(B, V, 3)`` to ``(B, H)`` radians in [-pi, pi], zero where flat."""
        rows = [gather_rows(vertices, self.hinges[:, place].expand(len(vertices), -1)) for place in range(4)]
        start, end, first, second = rows
        along = normalize(end - start, dim=-1)
        one = torch.linalg.cross(end - start, first - start, dim=-1)
        other = torch.linalg.cross(second - start, end - start, dim=-1)
        sine = (torch.linalg.cross(one, other, dim=-1) * along).sum(dim=-1)
        cosine = (one * other).sum(dim=-1)
        flat = sine.square() + cosine.square() < 1e-30  # a face without area has no angle
        return torch.atan2(sine.masked_fill(flat, 0), cosine.masked_fill(flat, 1))

    def differences(self, values: Tensor) -> Tensor:
        """Values ``(B, V, C)`` less the mean of their neighbours' along edges (the uniform Laplacian), alike."""
        return values - gather_sum(values, *self.neighbours)

    @cached_property
    def neighbours(self) -> tuple[SparseRows, SparseRows]:
        """The mean over a vertex's neighbours along edges, and its transpose."""
        edges = self.edges.cpu()
        both = torch.cat([edges, edges.flip(1)])
        both = both[both[:, 0].argsort(stable=True)]
        number = torch.bincount(both[:, 0])
        parts = both[:, 1], number.cumsum(0) - number, (1 / number.float())[both[:, 0]]
        mean = SparseRows(*(part.to(self.edges.device) for part in parts), len(number))
        return mean, mean.transpose()


def edge_strain(lengths: Tensor, rest: Tensor) -> Tensor:
    """Mean squared strain of edges, ``(B, E)`` lengths against those at rest ``(B, E)`` or ``(1, E)``."""
    return ((lengths - rest) / rest.clamp(min=1e-6)).square().mean()


def bending(angles: Tensor, rest: Tensor | None = None) -> Tensor:
    """Mean squared angle of hinges ``(B, H)``, radians, or how far it is from those at rest; a full turn is none."""
    if rest is None:
        return angles.square().mean()
    turn = angles - rest
    return torch.atan2(turn.sin(), turn.cos()).square().mean()


def body_contact(points: Tensor, body: Tensor, faces: Tensor, gap: float) -> Tensor:
    """Mean square of what points ``(B, N, 3)`` lack of a gap, metres, outside a body ``(B, V, 3)`` with faces.

    Along the normal of the nearest body vertex, as SNUG and PBNS measure it.
    """
    near = nearest(points.detach(), body)
    normals = vertex_normals(body, faces)
    heights = ((points - gather_rows(body, near)) * gather_rows(normals, near)).sum(dim=-1)
    return relu(gap - heights).square().mean()


def self_contact(points: Tensor, rest: Tensor, gap: float, apart: float, neighbours: int = 8) -> Tensor:
    """Mean square of what points ``(B, N, 3)`` lack of a gap between each other, metres: the largest lack of each.

    Of the nearest ``neighbours``, only those count that are farther ``apart`` at rest ``(N, 3)``.
    """
    ids = k_nearest(points.detach(), points.detach(), min(neighbours + 1, points.shape[1]))[..., 1:]
    far = (rest[ids] - rest[:, None]).norm(dim=-1) > apart
    others = gather_rows(points, ids.flatten(1)).unflatten(1, ids.shape[1:])
    squares = (others - points.unsqueeze(2)).square().sum(dim=-1)
    lack = relu(gap - squares.clamp(min=1e-12).sqrt()).square()
    return (lack * far).amax(dim=-1).mean()
