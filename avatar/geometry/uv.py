"""UV atlases: which surface point lies under each pixel, images of surface values, and where the seams run."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.surface import interpolate
from avatar.records import SurfaceSamples

INSIDE = 1e-12  # how far below zero rounding may take a barycentric coordinate of a point on an edge


@dataclass(frozen=True)
class UVGrid:
    """Pixels ``(N,)`` of a square image of ``size`` a side whose centres lie in the atlas, and the N points under them.

    Pixels are row-major and rising, row 0 at v = 0.
    """

    size: int
    pixels: Tensor
    samples: SurfaceSamples


def check_atlas(uv: Tensor, uv_faces: Tensor, faces: int) -> None:
    """Raises `AvatarError` for UV coordinates ``(U, 2)`` and corner indices ``(F, 3)`` that do not belong together."""
    check_shape("uv", uv, "U 2")
    check_shape("uv_faces", uv_faces, "F 3", F=faces)
    check_finite("uv", uv)
    if faces and not 0 <= int(uv_faces.min()) <= int(uv_faces.max()) < len(uv):
        got = f"{int(uv_faces.min())} to {int(uv_faces.max())}"
        raise AvatarError(f"uv_faces: expected indices in [0, {len(uv)}), got {got}.")


def rasterise_uv(uv: Tensor, uv_faces: Tensor, faces: Tensor, size: int) -> UVGrid:
    """The surface point under the centre of each pixel of an atlas.

    Pixel (row, column) has its centre at ``u = (column + 1/2) / size``, ``v = (row + 1/2) / size`` and belongs to the
    triangle that holds it, borders included, of several to that with the lowest index. ``uv (U, 2)`` are in [0, 1],
    ``uv_faces`` and ``faces (F, 3)`` a triangle's corners in the atlas and on the surface. Raises `AvatarError` for
    coordinates out of [0, 1], a size below 1, or an atlas that covers no pixel.
    """
    check_atlas(uv, uv_faces, check_shape("faces", faces, "F 3")["F"])
    if size < 1:
        raise AvatarError(f"size: expected at least 1 pixel, got {size}.")
    if len(uv) and not 0 <= float(uv.min()) <= float(uv.max()) <= 1:
        raise AvatarError(f"uv: expected coordinates in [0, 1], got {float(uv.min()):.3g} to {float(uv.max()):.3g}.")
    corners = uv.detach().double().cpu()[uv_faces.cpu()] * size - 0.5  # in pixels: centres at whole numbers
    face_ids, columns, rows = _candidates(corners)
    barycentric = uv_barycentric(torch.stack([columns, rows], dim=-1).double(), corners[face_ids])
    inside = barycentric.amin(dim=-1) >= -INSIDE  # false for NaN, that is for triangles without area
    pixels, face_ids, barycentric = (rows * size + columns)[inside], face_ids[inside], barycentric[inside]
    owner = torch.full((size * size,), len(faces)).scatter_reduce(0, pixels, face_ids, "amin")
    owned = owner[pixels] == face_ids
    pixels, order = pixels[owned].sort()
    if not len(pixels):
        raise AvatarError(f"uv: expected an atlas that covers pixels of a {size} x {size} image, got one without any.")
    face_ids, barycentric = face_ids[owned][order], barycentric[owned][order].clamp(min=0)
    barycentric = (barycentric / barycentric.sum(dim=-1, keepdim=True)).to(uv.dtype)
    samples = SurfaceSamples(faces.cpu()[face_ids], barycentric, face_ids)
    return UVGrid(size, pixels.to(uv.device), samples.to(uv.device))


def _candidates(corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Face, column and row of all pixel centres in the bounding boxes of triangles ``(F, 3, 2)``, faces rising."""
    low, high = corners.amin(dim=1).ceil().long(), corners.amax(dim=1).floor().long()
    extent = (high - low + 1).clamp(min=0)
    counts = extent.prod(dim=1)
    face_ids = torch.arange(len(corners)).repeat_interleave(counts)
    places = torch.arange(len(face_ids)) - (counts.cumsum(0) - counts)[face_ids]
    width = extent[face_ids, 0]
    return face_ids, low[face_ids, 0] + places % width, low[face_ids, 1] + places // width


def uv_barycentric(points: Tensor, triangles: Tensor) -> Tensor:
    """Barycentric coordinates ``(N, 3)`` of points ``(N, 2)`` in triangles ``(N, 3, 2)``, not finite without area.

    Outside a triangle one or two of them are negative: the coordinates then extrapolate its plane.
    """
    check_shape("triangles", triangles, "N 3 2", **check_shape("points", points, "N 2"))
    sides = torch.stack([_cross(triangles[:, i - 2] - points, triangles[:, i - 1] - points) for i in range(3)], dim=-1)
    first, second, third = triangles.unbind(dim=1)
    return sides / _cross(second - first, third - first).unsqueeze(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def uv_areas(uv: Tensor, uv_faces: Tensor) -> Tensor:
    """Area of each triangle in the atlas ``(F,)``, as a share of the unit square."""
    first, second, third = uv[uv_faces].unbind(dim=1)
    return _cross(second - first, third - first).abs() / 2


def sample_uv(uv: Tensor, uv_faces: Tensor, samples: SurfaceSamples) -> Tensor:
    """UV coordinates ``(N, 2)`` of surface points: within each one's own triangle, so never across a seam."""
    return interpolate(uv, SurfaceSamples(uv_faces[samples.face_ids], samples.barycentric, samples.face_ids))


def paint(values: Tensor, grid: UVGrid) -> Tensor:
    """The image of values on a mesh's vertices: ``(B, V, C)`` to ``(B, C, size, size)``, zero outside the atlas."""
    dims = check_shape("values", values, "B V C")
    image = values.new_zeros(dims["B"], dims["C"], grid.size * grid.size)
    image[..., grid.pixels] = interpolate(values, grid.samples).transpose(1, 2)
    return image.unflatten(-1, (grid.size, grid.size))


def seam_edges(faces: Tensor, uv_faces: Tensor) -> Tensor:
    """Edges ``(E, 2)`` of a mesh along which its atlas is cut, vertex ids rising: where POP's features jump.

    The triangles at their sides have them at different places in the atlas. Borders of the mesh are not seams.
    """
    check_shape("uv_faces", uv_faces, "F 3", **check_shape("faces", faces, "F 3"))
    edges = torch.cat([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    places = torch.cat([uv_faces[:, [i, (i + 1) % 3]] for i in range(3)])
    edges, order = edges.sort(dim=1)
    places = places.gather(1, order)
    ways = torch.unique(torch.cat([edges, places], dim=1), dim=0)
    unique, counts = torch.unique(ways[:, :2], dim=0, return_counts=True)
    return unique[counts > 1]
