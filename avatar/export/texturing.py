"""Textures of meshes of constant topology: a UV atlas, the place on the mesh of each texel, and colours from scans.

A texel is a place on the mesh (face and barycentric coordinates), so it is found again on the mesh in any pose. There it
takes the colours of the nearest points of that frame's scan; points of many frames fall between one another, which is
how a texture becomes finer than one scan's points are apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from avatar.checks import AvatarError, check_faces, check_shape, require
from avatar.geometry.laplacians import smooth_votes
from avatar.geometry.surface import vertex_normals
from avatar.geometry.trees import build_tree
from avatar.records import ClothedTemplate, Scan

LARGEST = 4096  # texels along a side of an image
PADDING = 4  # texels around a chart that continue its colours, for whoever samples between texels or makes mipmaps
NEIGHBOURS = 4  # scan points that a texel takes colours from, of each frame
SIGMA = 0.4  # of the spacing of a scan's points: distance at which a point's weight is 1 / e of the nearest one's
FACING = 0.5  # least cosine between the normals of texel and point
AGREEMENT = 0.15  # of colours in [0, 1]: root mean square difference from the first mean at which a weight is 1 / e
CHUNK = 1 << 18  # texels searched for at once
INSIDE = -1e-6  # barycentric coordinates from which on a texel's centre counts as inside


@dataclass(frozen=True)
class Unwrapped:
    """A mesh's UV atlas: ``uv (U, 2)`` float32 in [0, 1], v upwards, ``uv_faces (F, 3)`` index of each corner's,
    ``size`` of its image in texels, width and height, and ``texel``, metres at rest.
    """

    uv: np.ndarray
    uv_faces: np.ndarray
    size: tuple[int, int]
    texel: float


@dataclass(frozen=True)
class Places:
    """Places on a mesh: ``face_ids (T,)`` and ``barycentric (T, 3)``, which sum to 1."""

    face_ids: np.ndarray
    barycentric: np.ndarray

    def on(self, values: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Values ``(V, C)`` of a mesh's vertices at the places, ``(T, C)``."""
        return np.einsum("tk,tkc->tc", self.barycentric, values[faces[self.face_ids]])


@dataclass(frozen=True)
class TexelMap:
    """The texels of an image ``shape`` (height, width) that lie in a chart: ``texels (T,)`` flat index, and places."""

    shape: tuple[int, int]
    texels: np.ndarray
    places: Places


def unwrap(clothed: ClothedTemplate, texel: float) -> Unwrapped:
    """Unwraps the visible faces of a clothed template into one atlas, by xatlas.

    Covered faces, which are there in case a pose shows them, have one colour each: all their corners are the nearest
    visible vertex's. ``texel`` is the size of a texel at rest, metres; it becomes larger where the image would be wider
    or higher than `LARGEST`.

    Raises:
        AvatarError: for a size that is not positive, a template without visible faces, or without xatlas.
    """
    if not texel > 0:
        raise AvatarError(f"texel: expected a size above 0 metres, got {texel}.")
    shown = np.flatnonzero(clothed.visible_faces)
    if not len(shown):
        raise AvatarError("faces: expected a template with visible faces, got none.")
    xatlas = require("xatlas")
    used, corners = np.unique(clothed.faces[shown], return_inverse=True)
    vertices = np.ascontiguousarray(clothed.vertices[used], np.float32)
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, np.ascontiguousarray(corners.reshape(-1, 3), np.uint32))
    while True:
        options = xatlas.PackOptions()
        options.texels_per_unit, options.padding, options.bilinear = 1 / texel, PADDING, True
        atlas.generate(xatlas.ChartOptions(), options)
        if max(atlas.width, atlas.height) <= LARGEST:
            break
        texel *= 1.02 * max(atlas.width, atlas.height) / LARGEST
    source, indices, uv = atlas[0]
    uv = np.clip(np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1), 0, 1).astype(np.float32)
    uv_faces = np.empty(clothed.faces.shape, np.int64)
    uv_faces[shown] = indices.astype(np.int64)
    if len(hidden := np.flatnonzero(~clothed.visible_faces)):
        _, near = build_tree(vertices[source]).query(clothed.vertices[clothed.faces[hidden]].mean(axis=1))
        uv_faces[hidden] = near[:, None]
    return Unwrapped(uv, uv_faces, (int(atlas.width), int(atlas.height)), texel)


def map_texels(unwrapped: Unwrapped, shown: np.ndarray) -> TexelMap:
    """The texels whose centres lie in the UV triangles of the faces ``shown (F,)`` bool, each in one face.

    A face too small for any has the texel of its middle, where that is free.
    """
    width, height = unwrapped.size
    face_ids = np.flatnonzero(shown)
    corners = unwrapped.uv[unwrapped.uv_faces[face_ids]].astype(np.float64) * (width, height)
    corners[..., 1] = height - corners[..., 1]  # rows of an image count from the top
    owner = np.full(height * width, -1, np.int64)
    weights = np.zeros((height * width, 3), np.float32)
    low = np.maximum(np.floor(corners.min(axis=1) - 0.5).astype(np.int64), 0)
    high = np.minimum(np.ceil(corners.max(axis=1) - 0.5).astype(np.int64), (width - 1, height - 1))
    wide, tall = (high - low + 1).clip(min=0).T
    counts = wide * tall
    for part in np.array_split(np.arange(len(face_ids)), 1 + int(counts.sum()) // (CHUNK * 4)):
        which = np.repeat(part, counts[part])
        inner = np.arange(len(which)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
        columns = low[which, 0] + inner % wide[which]
        rows = low[which, 1] + inner // wide[which]
        found = planar_barycentric(np.stack([columns, rows], axis=1) + 0.5, corners[which])
        inside = found.min(axis=1) >= INSIDE
        texels = (rows * width + columns)[inside]
        owner[texels], weights[texels] = which[inside], found[inside]
    small = np.setdiff1d(np.arange(len(face_ids)), owner)
    middles = np.clip(np.floor(corners[small].mean(axis=1)).astype(np.int64), 0, (width - 1, height - 1))
    texels = middles[:, 1] * width + middles[:, 0]
    free = owner[texels] < 0
    owner[texels[free]], weights[texels[free]] = small[free], 1 / 3
    texels = np.flatnonzero(owner >= 0)
    barycentric = weights[texels].clip(0)
    barycentric /= barycentric.sum(axis=1, keepdims=True)
    return TexelMap((height, width), texels, Places(face_ids[owner[texels]], barycentric))


def planar_barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates ``(N, 3)`` of points ``(N, 2)`` in triangles ``(N, 3, 2)``; -1 in those without area."""
    first, second, away = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    flat = np.abs(area) < 1e-12
    area = np.where(flat, 1, area)
    s = (away[:, 0] * second[:, 1] - away[:, 1] * second[:, 0]) / area
    t = (first[:, 0] * away[:, 1] - first[:, 1] * away[:, 0]) / area
    return np.where(flat[:, None], -1, np.stack([1 - s - t, s, t], axis=1))


def vertex_places(faces: np.ndarray, count: int) -> Places:
    """A mesh's vertices as places, one each, on any of their faces; all must be of some face."""
    check_faces(faces, count)
    vertices, first = np.unique(faces, return_index=True)
    if len(vertices) != count:
        raise AvatarError(f"faces: expected a face at each of {count} vertices, got {len(vertices)} with one.")
    return Places(first // 3, np.eye(3, dtype=np.float32)[first % 3])


@dataclass
class ColorSums:
    """Weighted sums of the colours seen at places of a mesh, frame by frame: ``sums (T, 3)``, ``weights (T,)``.

    A point's weight falls with its distance from the place along the surface, ``exp(-(d / sigma)^2)``, where sigma is
    `SIGMA` of the spacing of the scan's points: so sharp that a place's colour is that of the points next to it, of
    whichever frames had them. With ``reference (T, 3)``, colours of a first pass, it also falls with the difference
    from those, so that what most frames say outweighs the rest.
    """

    places: Places
    faces: np.ndarray
    reach: float  # metres, from place to point
    sigma: float = SIGMA
    reference: np.ndarray | None = None
    sums: np.ndarray = field(init=False)
    weights: np.ndarray = field(init=False)

    def __post_init__(self):
        count = len(self.places.face_ids)
        self.sums, self.weights = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)

    def add(self, vertices: np.ndarray, scan: Scan) -> Self:
        """Adds what a coloured scan shows of the mesh's vertices ``(V, 3)`` in its pose."""
        dims = check_shape("points", scan.points, "M 3")
        check_shape("colors", scan.colors, "M 3", **dims)
        tree, sigma = build_tree(scan.points), self.sigma * point_spacing(scan.points)
        normals = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(self.faces)).numpy()
        count, colors = min(NEIGHBOURS, dims["M"]), np.asarray(scan.colors, np.float32)
        for start in range(0, len(self.weights), CHUNK):
            rows = slice(start, start + CHUNK)
            places = Places(self.places.face_ids[rows], self.places.barycentric[rows])
            points, facing = places.on(vertices, self.faces), places.on(normals, self.faces)
            facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
            distances, ids = tree.query(points, k=np.arange(1, count + 1), distance_upper_bound=self.reach)
            seen = np.flatnonzero(np.isfinite(distances[:, 0]))
            distances, ids = distances[seen], np.where(np.isfinite(distances[seen]), ids[seen], 0)
            aside = np.einsum("nkc,nc->nk", scan.points[ids] - points[seen, None], facing[seen])
            squared = np.maximum(distances**2 - aside**2, 0)
            weights = np.exp(-squared / sigma**2) + 1e-20 * (distances <= self.reach)
            weights *= np.isfinite(distances)
            weights *= np.einsum("nkc,nc->nk", scan.normals[ids], facing[seen]) > FACING
            if self.reference is not None:
                away = np.square(colors[ids] - self.reference[rows][seen][:, None]).mean(axis=2)
                weights *= np.exp(-away / AGREEMENT**2) + 1e-6
            self.sums[start + seen] += np.einsum("nk,nkc->nc", weights, colors[ids])
            self.weights[start + seen] += weights.sum(axis=1)
        return self

    @property
    def seen(self) -> np.ndarray:
        """Which places ``(T,)`` some scan has shown, bool."""
        return self.weights > 0

    @property
    def colors(self) -> np.ndarray:
        """The mean colours ``(T, 3)`` in [0, 1]; zero where none was seen."""
        return self.sums / np.maximum(self.weights, 1e-30)[:, None] * self.seen[:, None]


def point_spacing(points: np.ndarray) -> float:
    """The mean distance from a point to the nearest other one times two, metres: the side of the square that a point of
    a cloud ``(M, 3)`` drawn at random on a surface stands for.
    """
    if len(points) < 2:
        raise AvatarError(f"points: expected at least 2, got {len(points)}.")
    return max(2 * float(build_tree(points).query(points, k=[2])[0].mean()), 1e-6)
