"""Triangle surfaces and their points: areas, normals, sampling, barycentric interpolation."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.sparse import SparseRows, gather_sum
from avatar.records import SurfaceSamples

RINGS = WeakTensorKeyDictionary()  # faces to the sparse tables of `vertex_normals`


def face_cross_products(vertices: Tensor, faces: Tensor) -> Tensor:
    """Normal of each face, as long as twice its area. ``(..., V, 3)`` and ``(F, 3)`` to ``(..., F, 3)``."""
    check_shape("vertices", vertices, "... V 3")
    check_shape("faces", faces, "F 3")
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    return torch.linalg.cross(b - a, c - a, dim=-1)


def face_areas(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area of each face, square metres. ``(..., V, 3)`` to ``(..., F)``."""
    return face_cross_products(vertices, faces).norm(dim=-1) / 2


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals of the vertices. ``(..., V, 3)`` to ``(..., V, 3)``; zero where undefined.

    Repeatable on every device, backward pass included. The tables of a faces tensor are kept as long as it lives, so it
    must not change in place.
    """
    check_shape("vertices", vertices, "... V 3")
    check_shape("faces", faces, "F 3")
    count, kept = vertices.shape[-2], RINGS.get(faces)
    if kept is None or kept[0].rows != count:
        ids = faces.long()
        corners = [SparseRows.of_table(ids[:, corner, None], count) for corner in range(3)]
        around = SparseRows.of_table(ids, count).transpose()
        kept = (*corners, *(corner.transpose() for corner in corners), around, around.transpose())
        RINGS[faces] = kept
    a, b, c = (gather_sum(vertices, kept[corner], kept[3 + corner]) for corner in range(3))
    normals = gather_sum(torch.linalg.cross(b - a, c - a, dim=-1), *kept[6:])
    return torch.nn.functional.normalize(normals, dim=-1, eps=1e-20)


def sample_surface(vertices: Tensor, faces: Tensor, count: int, generator: torch.Generator) -> SurfaceSamples:
    """Points on a surface ``(V, 3)``, ``(F, 3)`` with uniform expected density, without any UV map.

    Stratified over the cumulative area: every part of the surface gets its share of points to within one. The state of
    the CPU's ``generator`` fixes them. Raises `AvatarError` for a surface without area or a count below 1.
    """
    check_shape("vertices", vertices, "V 3")
    if count < 1:
        raise AvatarError(f"count: expected at least 1 point, got {count}.")
    areas = face_areas(vertices, faces).double().cpu()
    total = float(areas.sum())
    if not 0 < total < torch.inf:
        raise AvatarError(f"vertices: expected a surface with area, got a total of {total} m^2.")
    cumulative = areas.cumsum(0)
    strata = (torch.arange(count) + torch.rand(count, generator=generator, dtype=torch.float64)) / count
    # right=True never stops at a face without area, nor does the clamp against rounding at the far end
    face_ids = torch.searchsorted(cumulative, strata * cumulative[-1], right=True).clamp(max=int(areas.nonzero()[-1]))
    root, along = torch.rand(2, count, generator=generator, dtype=torch.float64)
    root = root.sqrt()
    barycentric = torch.stack([1 - root, root * (1 - along), root * along], dim=-1)
    samples = SurfaceSamples(faces.cpu()[face_ids], barycentric.to(vertices.dtype), face_ids)
    return samples.to(vertices.device)


def interpolate(values: Tensor, samples: SurfaceSamples) -> Tensor:
    """Barycentric interpolation of per-vertex values (CloSET eq. 2). ``(..., V, C)`` to ``(..., N, C)``."""
    check_shape("values", values, "... V C")
    sparse = SparseRows.of_table(samples.vertex_ids, values.shape[-2], samples.barycentric)
    return gather_sum(values, sparse)


def interpolate_transforms(transforms: Tensor, samples: SurfaceSamples) -> Tensor:
    """Barycentric blend of per-vertex matrices, as POP blends vtransf. ``(..., V, D, D)`` to ``(..., N, D, D)``."""
    return interpolate(transforms.flatten(-2), samples).unflatten(-1, transforms.shape[-2:])


@torch.no_grad()
def farthest_points(points: Tensor, count: int, start: int = 0) -> Tensor:
    """Indices ``(count,)`` of a subset of points ``(N, 3)``, each the farthest from all before it (PointNet++).

    The first is ``start``. No index comes twice, not even where points coincide. O(N count): call it once on a constant
    template. Raises `AvatarError` for a count or start out of range, or coordinates that are not finite.
    """
    dims = check_shape("points", points, "N 3")
    if not 1 <= count <= dims["N"]:
        raise AvatarError(f"count: expected 1 to {dims['N']} points, got {count}.")
    if not 0 <= start < dims["N"]:
        raise AvatarError(f"start: expected an index in [0, {dims['N']}), got {start}.")
    check_finite("points", points)
    chosen = torch.empty(count, dtype=torch.long, device=points.device)
    distances = torch.full((dims["N"],), torch.inf, dtype=points.dtype, device=points.device)
    chosen[0] = start
    for i in range(1, count):
        distances = torch.minimum(distances, (points - points[chosen[i - 1]]).square().sum(dim=-1))
        distances[chosen[i - 1]] = -1  # below every distance: not chosen again
        chosen[i] = distances.argmax()
    return chosen
