"""Textures of meshes of constant topology: a UV atlas, the place on the mesh of each texel, and colours from scans.

A texel is a place on the mesh (face and barycentric coordinates), so it is found again on the mesh in any pose,
where it takes the colours of that frame's nearest scan points.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from avatar.checks import AvatarError, check_faces, check_shape, require
from avatar.geometry.closest import closest_on_mesh, closest_on_triangles
from avatar.geometry.laplacians import smooth_votes
from avatar.geometry.surface import vertex_normals
from avatar.geometry.trees import build_tree
from avatar.records import ClothedTemplate, Mesh, Scan

LARGEST = 4096  # texels along a side of an image
PADDING = 4  # texels around a chart that continue its colours, for whoever samples between texels or makes mipmaps
NEIGHBOURS = 8  # scan points that a texel takes colours from
WIDE = 1.5  # spacings of a scan's points along the surface: a texel with none so near was not seen
SIGMA = 0.6  # of the spacing of a scan's points: distance at which a point's weight is 1 / e of the nearest one's
ALIKE = 0.1  # root mean square difference of colours in [0, 1] at which a point's weight is 1 / e of an equal one's
ROUNDS = 2  # of weighing by colour
FACING = 0.5  # least cosine between the normals of texel and point
BORDER = 0.05  # metres at rest between skin and garment within which one may have taken colours of the other
NEARBY = 200  # texels beyond a border that say which colours a part has
FEW = 0.1  # share of them that does not count
SMOOTH = 0.002  # metres over which colours of vertices are smoothed before they are continued
CHUNK = 1 << 16  # texels searched for at once
INSIDE = -1e-6  # barycentric coordinates from which on a texel's centre counts as inside


class Blend(Enum):
    """What a texel takes of the frames that show it."""

    first = "first"  # the colours of the one that fits best: small figures stay
    mean = "mean"  # the mean over all, which blurs what slides below the mesh


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

    def some(self, rows: np.ndarray) -> Places:
        """Some of the places, by index."""
        return Places(self.face_ids[rows], self.barycentric[rows])


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
    for part in np.array_split(np.arange(len(face_ids)), 1 + int(counts.sum()) // (16 * CHUNK)):
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


@dataclass(frozen=True)
class SeenColors:
    """Colours ``(T, 3)`` float32 in [0, 1] at places of a mesh, zero where none was seen; ``frames (T,)`` which of the
    frames, in the order they were looked at, showed each, -1 for none.
    """

    colors: np.ndarray
    frames: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Which places ``(T,)`` some frame has shown, bool."""
        return self.frames >= 0


def bake(
    places: Places,
    faces: np.ndarray,
    shown: Iterable[tuple[np.ndarray, Scan]],
    reach: float,
    blend: Blend = Blend.first,
) -> SeenColors:
    """Colours of places on a mesh from coloured scans, by default those of the first frame that shows each place.

    A mesh follows cloth along its normals and not along itself: from frame to frame cloth slides by centimetres below
    it, and a mean over frames has no small figures left. One frame has them all, in their places; those after it fill
    what it did not see. So the order matters: the frame that fits best comes first.

    Args:
        places: where.
        faces: ``(F, 3)`` of the mesh.
        shown: vertices ``(V, 3)``, metres, and the coloured scan of each frame; asked for one at a time.
        reach: metres from a place to the points that it takes colours from.
        blend: the first frame that shows a place, or the mean over all.

    Raises:
        AvatarError: for a scan without colours, or of fewer than two points.
    """
    count = len(places.face_ids)
    colors, frames = np.zeros((count, 3), np.float32), np.full(count, -1, np.int64)
    total = np.zeros(count, np.float32)
    for number, (vertices, scan) in enumerate(shown):
        wanted = np.flatnonzero(frames < 0) if blend is Blend.first else np.arange(count)
        if not len(wanted):
            break
        found, weights = mean_colors(places.some(wanted), faces, vertices, scan, reach)
        wanted, found, weights = (part[weights > 0] for part in (wanted, found, weights))
        total[wanted] += weights
        colors[wanted] += (found - colors[wanted]) * (weights / total[wanted])[:, None]
        frames[wanted] = np.where(frames[wanted] < 0, number, frames[wanted])
    return SeenColors(colors, frames)


def mean_colors(
    places: Places, faces: np.ndarray, vertices: np.ndarray, scan: Scan, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Colours ``(T, 3)`` of the `NEIGHBOURS` points of a scan nearest to each place, and the sum ``(T,)`` of weights.

    A bilateral mean (Tomasi and Manduchi 1998): a point's weight falls with its distance along the surface,
    ``exp(-(d / sigma)^2)``, where sigma is `SIGMA` of the spacing of the scan's points, and with the difference of its
    colour from the mean so far, ``exp(-(c / ALIKE)^2)``. So a place at a border between two colours has that of more
    points near it, not one between. Points on another side (`FACING`), beyond ``reach`` or beyond `WIDE` spacings along
    the surface have none.
    """
    dims = check_shape("points", scan.points, "M 3")
    if scan.colors is None:
        raise AvatarError("scan: expected one with colours, got none.")
    check_shape("colors", scan.colors, "M 3", **dims)
    tree, spacing = build_tree(scan.points), point_spacing(scan.points)
    sigma, wide = SIGMA * spacing, WIDE * spacing
    normals = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(faces)).numpy()
    found, sums = np.zeros((len(places.face_ids), 3), np.float32), np.zeros(len(places.face_ids), np.float32)
    nearest = np.arange(1, min(NEIGHBOURS, dims["M"]) + 1)
    for start in range(0, len(sums), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(sums)))
        points, facing = places.some(rows).on(vertices, faces), places.some(rows).on(normals, faces)
        distances, ids = tree.query(points, k=nearest, distance_upper_bound=reach)
        near = np.isfinite(distances[:, 0])
        rows, points, facing, distances, ids = (part[near] for part in (rows, points, facing, distances, ids))
        there = np.isfinite(distances)
        ids = np.where(there, ids, 0)
        facing = facing / np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
        away = scan.points[ids] - points[:, None]
        squared = np.maximum(np.square(away).sum(axis=2) - np.einsum("nkc,nc->nk", away, facing) ** 2, 0)
        there &= (np.einsum("nkc,nc->nk", scan.normals[ids], facing) > FACING) & (squared < wide**2)
        weights = there * np.maximum(np.exp(-(squared - squared[:, :1]) / sigma**2).clip(max=1e6), 1e-12)
        sums[rows] = weights.sum(axis=1)
        found[rows] = bilateral_mean(np.asarray(scan.colors, np.float64)[ids], weights)
    return np.clip(found, 0, 1), sums


def bilateral_mean(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The mean ``(N, 3)`` of colours ``(N, K, 3)`` with weights ``(N, K)`` that fall with the difference from it."""
    alike = weights
    for turn in range(ROUNDS + 1):
        mean = np.einsum("nk,nkc->nc", alike, colors) / np.maximum(alike.sum(axis=1), 1e-30)[:, None]
        if turn < ROUNDS:
            away = np.square(colors - mean[:, None]).mean(axis=2)
            alike = weights * np.maximum(np.exp(-away / ALIKE**2), 1e-9)
    return mean


def fit_distance(vertices: np.ndarray, scan: Scan, far: float) -> float:
    """The mean distance from a mesh's vertices to the scan's points, each counted to ``far`` at most, metres."""
    distances, _ = build_tree(scan.points).query(vertices, distance_upper_bound=far)
    return float(np.minimum(distances, far).mean())


def drop_mixed_borders(places: Places, seen: SeenColors, clothed: ClothedTemplate) -> SeenColors:
    """Colours without those that skin took from the garment, or the garment from skin, where the two meet.

    Mesh and scan do not end at the same place, so a collar has points of the neck next to it. A place within `BORDER`
    of the other part at rest is taken for unseen if its colour is alike (`ALIKE`) to those of the other part beyond its
    border, and not, but for a few, to those of its own part there. Trimmings of a third colour stay.
    """
    points, kinds = places.on(clothed.vertices, clothed.faces), clothed.garment_faces[places.face_ids]
    if kinds.all() or not kinds.any():
        return seen
    trees = {kind: build_tree(points[kinds == kind]) for kind in (False, True)}
    near = np.zeros(len(points), bool)
    for kind, tree in trees.items():
        mine = np.flatnonzero(kinds != kind)
        near[mine] = np.isfinite(tree.query(points[mine], distance_upper_bound=BORDER)[0])
    dropped = np.zeros(len(points), bool)
    mixed = np.flatnonzero(near & seen.seen)
    for kind in (False, True):
        own, other = (np.flatnonzero(seen.seen & ~near & (kinds == which)) for which in (kind, not kind))
        mine = mixed[kinds[mixed] == kind]
        if len(own) and len(other) and len(mine):
            shares = [
                share_alike(points[mine], seen.colors[mine], points[ids], seen.colors[ids]) for ids in (own, other)
            ]
            dropped[mine] = (shares[0] < FEW) & (shares[1] > 0)
    return SeenColors(seen.colors * ~dropped[:, None], np.where(dropped, -1, seen.frames))


def share_alike(points: np.ndarray, colors: np.ndarray, others: np.ndarray, other_colors: np.ndarray) -> np.ndarray:
    """The share ``(N,)`` of the `NEARBY` other places next to each that have a colour like its own (`ALIKE`)."""
    tree, nearest, shares = build_tree(others), np.arange(1, min(NEARBY, len(others)) + 1), np.empty(len(points))
    for rows in np.array_split(np.arange(len(points)), 1 + len(points) * NEARBY // (16 * CHUNK)):
        _, ids = tree.query(points[rows], k=nearest)
        away = np.square(other_colors[ids] - colors[rows][:, None]).mean(axis=2)
        shares[rows] = (away < ALIKE**2).mean(axis=1)
    return shares


def fill_unseen(
    places: Places, colors: np.ndarray, seen: np.ndarray, vertices: np.ndarray, faces: np.ndarray, fixed: np.ndarray
) -> np.ndarray:
    """Colours ``(T, 3)`` at all places: those that were not seen take what is around them on the surface, smoothly.

    Vertices near seen places take their mean colours, the others continue them over the surface; a connected part
    ``faces (F, 3)`` of which nothing was seen has the mean colour of its kind ``fixed (F,)`` (bool, such as garment),
    or else of all. Raises `AvatarError` where nothing at all was seen.
    """
    if not seen.any():
        raise AvatarError("scans: expected some to show the mesh, none does. Hint: a larger reach=...")
    rest = np.flatnonzero(~seen)
    if not len(rest):
        return colors
    some = places.some(np.flatnonzero(seen))
    corners, shares = faces[some.face_ids].reshape(-1), some.barycentric.reshape(-1)
    total = np.bincount(corners, shares, len(vertices))
    confidence = np.minimum(total, 1.0)
    means = np.empty((len(vertices), 3))
    for channel in range(3):
        sums = np.bincount(corners, shares * colors[seen][:, channel].repeat(3), len(vertices))
        mean = sums / np.maximum(total, 1e-12)
        means[:, channel] = smooth_votes(vertices, faces, mean, confidence, SMOOTH)
    kinds = fixed[places.face_ids]
    for kind in (False, True):
        alike = colors[seen & (kinds == kind)] if (seen & (kinds == kind)).any() else colors[seen]
        mine = np.unique(faces[fixed == kind])
        mine = mine[np.isnan(means[mine]).any(axis=1)]
        means[mine] = alike.mean(axis=0)
    filled = colors.copy()
    filled[rest] = places.some(rest).on(np.nan_to_num(means).clip(0, 1).astype(np.float32), faces)
    return filled


def paint_image(texels: TexelMap, colors: np.ndarray) -> np.ndarray:
    """The image ``(H, W, 3)`` uint8 of colours ``(T, 3)`` in [0, 1] of texels, continued around the charts.

    Texels within twice `PADDING` of a chart take the colour of its nearest texel, so that what samples between texels,
    or halves the image once, sees no background; the rest has the mean colour.
    """
    height, width = texels.shape
    image = np.empty((height, width, 3), np.uint8)
    image[:] = np.rint(colors.mean(axis=0) * 255)
    empty = np.ones((height, width), bool)
    empty.flat[texels.texels] = False
    image.reshape(-1, 3)[texels.texels] = np.rint(np.clip(colors, 0, 1) * 255)
    distance, (rows, columns) = distance_transform_edt(empty, return_indices=True)
    around = empty & (distance <= 2 * PADDING)
    image[around] = image[rows[around], columns[around]]
    return image


def sample_image(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours ``(N, 3)`` in [0, 1] of an image ``(H, W, 3)`` uint8 at coordinates ``(N, 2)``, v upwards, bilinear."""
    height, width = image.shape[:2]
    column, row = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    across, down = (column - left)[:, None], (row - top)[:, None]

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64) / 255

    upper = at(left, top) * (1 - across) + at(left + 1, top) * across
    lower = at(left, top + 1) * (1 - across) + at(left + 1, top + 1) * across
    return upper * (1 - down) + lower * down


def encode_png(image: np.ndarray) -> bytes:
    """An image ``(H, W, 3)`` uint8 as the bytes of a PNG file; equal images, equal bytes."""
    encoded = io.BytesIO()
    require("PIL.Image").fromarray(image).save(encoded, format="PNG", optimize=True)
    return encoded.getvalue()


def points_on_mesh(scan: Scan, vertices: np.ndarray, faces: np.ndarray, near: float) -> tuple[Places, np.ndarray]:
    """The places on a mesh that are nearest to a scan's points, and the points' index ``(K,)``.

    Points farther than ``near`` metres, or that look another way than the mesh, are left out.
    """
    hits = closest_on_mesh(scan.points, vertices, faces, near)
    corners = np.asarray(vertices, np.float64)[faces[hits.face_ids]]
    _, barycentric = closest_on_triangles(hits.points, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    kept = np.abs(hits.signed_distances) < near
    kept &= np.einsum("nc,nc->n", normals, scan.normals) > FACING
    return Places(hits.face_ids[kept], barycentric[kept]), np.flatnonzero(kept)


def fine_mesh(mesh: Mesh, unwrapped: Unwrapped, image: np.ndarray, shown: np.ndarray, parts: int = 6) -> Mesh:
    """The faces ``shown`` of a mesh cut into ``parts ** 2`` triangles each, whose vertices have the texture's colours.

    It shows a texture where vertex colours alone can be drawn; triangles share no vertices.
    """
    faces = np.flatnonzero(shown)
    first, second = (grid.reshape(-1) for grid in np.meshgrid(*[np.arange(parts + 1)] * 2, indexing="ij"))
    kept = first + second <= parts
    first, second = first[kept], second[kept]
    weights = np.stack([parts - first - second, first, second], axis=1) / parts
    number = {place: index for index, place in enumerate(zip(first.tolist(), second.tolist()))}
    small = []
    for a, b in number:
        if a + b < parts:
            small.append((number[a, b], number[a + 1, b], number[a, b + 1]))
        if a + b < parts - 1:
            small.append((number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]))
    points = np.einsum("pk,fkc->fpc", weights, np.asarray(mesh.vertices, np.float64)[mesh.faces[faces]])
    uv = np.einsum("pk,fkc->fpc", weights, unwrapped.uv[unwrapped.uv_faces[faces]].astype(np.float64))
    corners = np.array(small)[None] + (np.arange(len(faces)) * len(weights))[:, None, None]
    colors = sample_image(image, uv.reshape(-1, 2))
    return Mesh(points.reshape(-1, 3).astype(np.float32), corners.reshape(-1, 3), colors.astype(np.float32))


def point_spacing(points: np.ndarray) -> float:
    """The mean distance from a point to the nearest other one times two, metres: the side of the square that a point of
    a cloud ``(M, 3)`` drawn at random on a surface stands for.
    """
    if len(points) < 2:
        raise AvatarError(f"points: expected at least 2, got {len(points)}.")
    return max(2 * float(build_tree(points).query(points, k=[2])[0].mean()), 1e-6)
