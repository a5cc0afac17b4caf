"""Mean winding number of many canonical scans on a grid, its surface, and what part of that surface scans support.

The winding number of a scan is 1 inside and 0 outside; that of a scan with holes or open ends passes smoothly from one
to the other there. It is linear in the oriented surface, so the mean over scans takes one Poisson solve whatever their
number (Barill et al. 2018; Kazhdan et al. 2006 for the spectral form), and its surface at 0.5 is a majority vote of the
scans' insides: one closed surface with outward normals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.fft
import trimesh
from scipy.ndimage import map_coordinates

from avatar.checks import AvatarError, check_finite, check_shape, require
from avatar.geometry.trees import build_tree
from avatar.records import CanonicalScan, Mesh

MARGIN = 0.16  # metres of empty space around the scans: the solve is periodic
MAX_CELLS = 1 << 26
DISC_NEIGHBOURS = 8  # points of a scan without faces whose distances tell how large an area each stands for
REACH = 0.3  # metres along the field on either side of the surface in which its layers are looked for
TURNED = 0.3  # cosine to the direction at the surface below which the field belongs to another surface


@dataclass
class WindingGrid:
    """Area vectors of scans on a regular grid, summed, and the mean winding number of those scans.

    ``low (3,)`` the first node, ``spacing`` metres between nodes, ``vectors (2, 3, X, Y, Z)`` outward area vectors per
    volume: of points of the first and of the second kind (skin and garment); ``scans`` how many were added.
    """

    low: np.ndarray
    spacing: float
    shape: tuple[int, int, int]
    vectors: np.ndarray = field(init=False)
    scans: int = field(default=0, init=False)

    def __post_init__(self):
        self.vectors = np.zeros((2, 3, int(np.prod(self.shape))), np.float32)

    def add(self, points: np.ndarray, vectors: np.ndarray, second: np.ndarray) -> None:
        """Adds a scan: points ``(M, 3)``, area vectors ``(M, 3)``, and which points are of the second kind ``(M,)``."""
        places = (points - self.low) / self.spacing
        first = np.floor(places).astype(np.int64)
        inside = ((first >= 0) & (first < np.array(self.shape) - 1)).all(axis=1)
        first, share = first[inside], places[inside] - first[inside]
        density = vectors[inside].astype(np.float64) / self.spacing**3
        kinds = second[inside].astype(np.int64)
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, share, 1 - share), axis=1)
            nodes = np.ravel_multi_index(tuple((first + corner).T), self.shape)
            for axis in range(3):
                np.add.at(self.vectors[:, axis], (kinds, nodes), (weight * density[:, axis]).astype(np.float32))
        self.scans += 1

    def solve(self, blur: float) -> Winding:
        """The mean winding number of the scans added, and their mean area vectors, blurred by a Gaussian.

        ``blur`` is its standard deviation, metres: where scans are few, at least about the distance between a scan's
        points. Raises `AvatarError` when no scan was added.
        """
        if not self.scans:
            raise AvatarError("scans: expected at least one canonical scan, got none.")
        waves = np.meshgrid(
            *(2 * np.pi * scipy.fft.fftfreq(n, self.spacing).astype(np.float32) for n in self.shape[:2]),
            2 * np.pi * scipy.fft.rfftfreq(self.shape[2], self.spacing).astype(np.float32),
            indexing="ij",
            sparse=True,
        )
        squares = sum(wave**2 for wave in waves)
        damping = np.exp(-0.5 * blur**2 * squares) / self.scans
        divergence, blurred = 0.0, np.empty((2, 3, *self.shape), np.float32)
        for axis, wave in enumerate(waves):
            for kind in range(2):
                spectrum = scipy.fft.rfftn(self.vectors[kind, axis].reshape(self.shape)) * damping
                blurred[kind, axis] = scipy.fft.irfftn(spectrum, self.shape)
                divergence = divergence + 1j * wave * spectrum
        squares[0, 0, 0] = 1
        spectrum = divergence / squares
        spectrum[0, 0, 0] = 0
        numbers = scipy.fft.irfftn(spectrum, self.shape).astype(np.float32)
        sides = [numbers[0], numbers[-1], numbers[:, 0], numbers[:, -1], numbers[:, :, 0], numbers[:, :, -1]]
        numbers -= np.mean([side.mean() for side in sides])
        return Winding(self.low, self.spacing, numbers, blurred)


def grid_around(low: np.ndarray, high: np.ndarray, spacing: float, margin: float = MARGIN) -> WindingGrid:
    """An empty grid that holds a box ``(3,)``, ``(3,)`` and a margin around it, metres.
    Raises `AvatarError` when it would have more than 64 million nodes.
    """
    shape = tuple(int(scipy.fft.next_fast_len(int(n), real=True)) for n in np.ceil((high - low + 2 * margin) / spacing))
    if np.prod(shape) > MAX_CELLS:
        raise AvatarError(
            f"spacing: expected at most {MAX_CELLS} grid nodes, {spacing * 1000:.3g} mm needs {np.prod(shape)}. "
            "Hint: take a larger spacing."
        )
    slack = (np.array(shape) - 1) * spacing - (high - low)
    return WindingGrid(low - slack / 2, spacing, shape)


@dataclass(frozen=True)
class Winding:
    """A mean winding number on a grid: ``numbers (X, Y, Z)`` and the blurred ``vectors (2, 3, X, Y, Z)`` behind it."""

    low: np.ndarray
    spacing: float
    numbers: np.ndarray
    vectors: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """The winding number ``(N,)`` at points ``(N, 3)``, trilinear; that of the border outside."""
        return self._look_up(self.numbers, points)

    def _look_up(self, grid: np.ndarray, points: np.ndarray) -> np.ndarray:
        return map_coordinates(grid, ((points - self.low) / self.spacing).T, order=1, mode="nearest")

    def gradient_at(self, points: np.ndarray) -> np.ndarray:
        """The gradient ``(N, 3)`` at points ``(N, 3)``, per metre, by central differences of one grid spacing."""
        return np.stack([self._look_up(slope, points) for slope in self._slopes], axis=1)

    @cached_property
    def _slopes(self) -> list[np.ndarray]:
        return np.gradient(self.numbers, self.spacing)

    def vectors_at(self, kind: int, points: np.ndarray) -> np.ndarray:
        """Mean area vectors of a kind ``(N, 3)`` per metre at points ``(N, 3)``."""
        return np.stack([self._look_up(self.vectors[kind, axis], points) for axis in range(3)], axis=1)

    def surface(self, level: float = 0.5) -> Mesh:
        """The closed surface where the winding number is ``level``, wound outwards.
        Raises `AvatarError` when there is none: the scans agree on no inside.
        """
        if not self.numbers.min() < level < self.numbers.max():
            raise AvatarError(
                f"scans: expected a majority of them to enclose a volume, the mean winding number is at most "
                f"{self.numbers.max():.2f}. Hint: check that their normals point outwards and that they are in metres."
            )
        vertices, faces, _, _ = require("skimage.measure").marching_cubes(
            self.numbers, level, spacing=(self.spacing,) * 3, gradient_direction="ascent"
        )
        return Mesh(vertices + self.low, faces.astype(np.int64))

    def support(self, points: np.ndarray) -> np.ndarray:
        """How much of the step from outside to inside is scan, and of which kind: shares ``(N, 2)`` in [0, 1].

        Along the field through each point of the surface, the area vectors crossed are set against the change of the
        winding number. Where scans lie, however far they scatter around their mean surface, the two are equal; where
        the field closes an opening (a hem, a hole of all scans) no scan is crossed. A share above a half says that more
        than half of the scans have a surface here: the same majority as the vote for the inside.
        """
        crossed = np.zeros((len(points), 2))
        total = np.zeros(len(points))
        start = -self.gradient_at(points)
        start /= np.maximum(np.linalg.norm(start, axis=1, keepdims=True), 1e-9)
        step = self.spacing
        for side in (1.0, -1.0):
            places, going = points + side * step / 2 * start, np.arange(len(points))
            directions = start
            for _ in range(int(REACH / step)):
                slopes = -self.gradient_at(places)
                lengths = np.linalg.norm(slopes, axis=1)
                directions = slopes / np.maximum(lengths[:, None], 1e-9)
                kept = (np.einsum("ni,ni->n", directions, start[going]) > TURNED) & (lengths > 0.02)
                places, going, directions, lengths = places[kept], going[kept], directions[kept], lengths[kept]
                if not len(going):
                    break
                total[going] += lengths
                for kind in range(2):
                    crossed[going, kind] += np.einsum("ni,ni->n", self.vectors_at(kind, places), directions)
                places = places + side * step * directions
        return np.clip(crossed / np.maximum(total[:, None], 1e-9), 0, 1)


def area_vectors(scan: CanonicalScan) -> np.ndarray:
    """The oriented area ``(M, 3)`` that each point of a canonical scan stands for, square metres.

    Of a mesh a third of the faces around it; of points alone, the disc that its neighbours leave to it.
    """
    check_shape("normals", scan.normals, "M 3", **check_shape("points", scan.points, "M 3"))
    check_finite("points", scan.points)
    if scan.faces is None:
        return scan.normals * disc_areas(scan.points)[:, None]
    crosses = trimesh.triangles.cross(scan.points.astype(np.float64)[scan.faces]) / 6
    corners = scan.faces.reshape(-1)
    return np.stack([np.bincount(corners, axis.repeat(3), minlength=len(scan.points)) for axis in crosses.T], axis=1)


def disc_areas(points: np.ndarray) -> np.ndarray:
    """Areas ``(M,)`` of points ``(M, 3)`` spread over a surface: the disc that holds so many neighbours, shared."""
    count = min(DISC_NEIGHBOURS, len(points) - 1)
    if count < 1:
        return np.zeros(len(points))
    distances, _ = build_tree(points).query(points, k=count + 1)
    return np.pi * distances[:, -1] ** 2 / (count + 0.5)
