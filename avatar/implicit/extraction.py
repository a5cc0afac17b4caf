"""The zero surface of a signed distance as a mesh: the field is asked only near the surface, coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.sparse as sparse
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_finite, check_range, check_shape, require
from avatar.geometry.chunks import in_chunks
from avatar.records import Mesh

CHUNK = 65_536  # points the field is asked at once, or fewer where memory runs out
CORNERS = tuple(product((0, 1), repeat=3))
# Largest mean distance from a point of a unit cube to its corners, at a corner: (0 + 3 + 3 sqrt 2 + sqrt 3) / 8. With
# Lipschitz constant L a cell of side s holds no zero where the mean |f| of its corners is above this times L s.
REACH = (3 + 3 * math.sqrt(2) + math.sqrt(3)) / 8


@dataclass
class ExtractionConfig:
    """How fine a surface is, and what of it is kept."""

    resolution: int = 256  # cells along the longest side of the box
    coarsest: int = 16  # of these the first pass has at least so many along the longest side
    lipschitz: float = 1.3  # bound on the field's slope; learned distances are a little steeper than 1 in places
    parts: int = 1  # connected parts kept, those of largest area; 0 keeps all

    def __post_init__(self):
        check_range(self, "resolution", low=4, high=2048)
        if not 4 <= self.coarsest <= self.resolution:
            raise AvatarError(f"coarsest: expected 4 to resolution={self.resolution}, got {self.coarsest}.")
        check_range(self, "lipschitz", above=0)
        check_range(self, "parts", low=0)


def extract_surface(field: Callable[[Tensor], Tensor], box: Tensor, config: ExtractionConfig | None = None) -> Mesh:
    """The surface where a signed distance is zero, wound so that normals point to positive values.

    Marching cubes on values that are exact in every cell that can hold the surface; the mesh is that of a dense
    grid as long as the field is nowhere steeper than ``lipschitz``. The field takes ``(N, 3)`` points to ``(N,)``
    distances, metres, negative inside; ``box (2, 3)`` are the lowest and highest corner of the space to look in.
    Raises `AvatarError` when the field has no zero in the box, or is not finite.
    """
    check_shape("box", box, "2 3")
    config = config or ExtractionConfig()
    step = float((box[1] - box[0]).max()) / config.resolution
    levels = int(math.log2(config.resolution / config.coarsest))
    coarse = step * 2**levels
    shape = tuple(int(n) + 1 for n in ((box[1] - box[0]) / coarse - 1e-6).ceil().clamp(min=1))
    low, high = box[0], box[0] + coarse * (torch.tensor(shape, device=box.device) - 1)

    values = np.zeros(shape, np.float32)
    wanted = np.ones(shape, bool)
    near = np.ones(tuple(n - 1 for n in shape), bool)
    _evaluate(field, low, coarse, values, wanted)
    for level in range(levels):
        near &= _may_hold_zero(values, config.lipschitz * coarse / 2**level)
        values, wanted = _refine(values), _nodes_within(near)
        near = near.repeat(2, 0).repeat(2, 1).repeat(2, 2)
        _evaluate(field, low, coarse / 2 ** (level + 1), values, wanted)
    if not values.min() < 0 < values.max():
        raise AvatarError(
            f"field: expected a zero between {low.tolist()} and {high.tolist()}, its values there reach from "
            f"{values.min():.3g} to {values.max():.3g} m. Train longer, or check the scans the field was trained on."
        )
    march = require("skimage.measure").marching_cubes
    vertices, faces, _, _ = march(values, 0.0, gradient_direction="descent")
    vertices = (vertices * step + low.cpu().numpy()).astype(np.float32)
    return largest_parts(Mesh(vertices, faces.astype(np.int64)), config.parts)


@torch.no_grad()
def _evaluate(
    field: Callable[[Tensor], Tensor], low: Tensor, step: float, values: np.ndarray, wanted: np.ndarray
) -> None:
    """Puts the field's values at the wanted nodes."""
    nodes = torch.from_numpy(np.argwhere(wanted)).to(low.device)
    if len(nodes):
        parts = in_chunks(lambda part: field(low + step * nodes[part].to(low.dtype)).float().cpu(), len(nodes), CHUNK)
        joined = torch.cat(parts)
        check_finite("field", joined)
        values[wanted] = joined.numpy()


def _may_hold_zero(values: np.ndarray, slope: float) -> np.ndarray:
    """Cells whose corners differ in sign or are near zero; ``slope`` is the most a value can change over a side."""
    x, y, z = (size - 1 for size in values.shape)
    corners = [values[a : a + x, b : b + y, c : c + z] for a, b, c in CORNERS]
    inside = sum((corner < 0).astype(np.int8) for corner in corners)
    near = sum(np.abs(corner) for corner in corners) / 8 <= REACH * slope
    return near | ((inside > 0) & (inside < 8))


def _refine(values: np.ndarray) -> np.ndarray:
    """The same values at twice the resolution, midpoints interpolated: their signs are right where no zero is near."""
    for axis in range(3):
        first = np.moveaxis(values, axis, 0)
        finer = np.empty((2 * len(first) - 1, *first.shape[1:]), np.float32)
        finer[::2] = first
        finer[1::2] = (first[:-1] + first[1:]) / 2
        values = np.moveaxis(finer, 0, axis)
    return np.ascontiguousarray(values)


def _nodes_within(cells: np.ndarray) -> np.ndarray:
    """Nodes of the finer grid on or inside the given cells, less those that the coarser grid has."""
    nodes = np.zeros(tuple(2 * size + 1 for size in cells.shape), bool)
    x, y, z = (2 * size for size in cells.shape)
    for a, b, c in product((0, 1, 2), repeat=3):
        nodes[a : a + x : 2, b : b + y : 2, c : c + z : 2] |= cells
    nodes[::2, ::2, ::2] = False
    return nodes


def largest_parts(mesh: Mesh, parts: int) -> Mesh:
    """A mesh's connected parts of largest area; 0 keeps all of them."""
    if not parts:
        return mesh
    pairs = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(mesh.vertices),) * 2)
    _, labels = sparse.csgraph.connected_components(graph, directed=False)
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    of_face = labels[mesh.faces[:, 0]]
    kept = np.argsort(-np.bincount(of_face, areas, labels.max() + 1), kind="stable")[:parts]
    used, faces = np.unique(mesh.faces[np.isin(of_face, kept)], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int64))
