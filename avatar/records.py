"""The records that cross module borders. Letters: B batch, N points, M scan points, V vertices, F faces, J joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self, TypeVar

import numpy as np
import torch
from torch import Tensor

Record = TypeVar("Record")


def map_tensors(record: Record, change: Callable[[Tensor], Tensor]) -> Record:
    """The same record with each of its tensors changed by a function; what is no tensor stays."""
    values = {field.name: getattr(record, field.name) for field in fields(record)}
    return replace(record, **{name: change(value) for name, value in values.items() if isinstance(value, Tensor)})


class Tensors:
    """A record of tensors that are moved and cast together."""

    def to(self, *args, **kwargs) -> Self:
        """The same record with floating-point tensors moved or cast by `Tensor.to`, and indices moved only."""

        def move(tensor: Tensor) -> Tensor:
            if tensor.is_floating_point():
                return tensor.to(*args, **kwargs)
            return tensor.to(tensor.new_empty(0, dtype=torch.float32).to(*args, **kwargs).device)

        return map_tensors(self, move)


@dataclass(frozen=True)
class Template(Tensors):
    """A body at rest in its canonical pose: metres, right-handed, y up, facing +z."""

    vertices: Tensor  # (V, 3)
    faces: Tensor  # (F, 3) int64
    weights: Tensor  # (V, J) for skinning, rows sum to 1
    joints: Tensor  # (J, 3) in the canonical pose
    parents: tuple[int, ...]  # -1 for the root, every parent before its children
    joint_names: tuple[str, ...]
    canonical_from_bind: Tensor | None = None  # (J, 4, 4) from the pose of the weights; None if canonical
    uv: Tensor | None = None  # (U, 2) in [0, 1]; None for a body without atlas
    uv_faces: Tensor | None = None  # (F, 3) each corner's index into uv


@dataclass(frozen=True)
class PosedBody:
    """A batch of posed bodies. All transforms are posed_from_canonical."""

    vertices: Tensor  # (B, V, 3)
    joint_transforms: Tensor  # (B, J, 4, 4) rigid
    vertex_transforms: Tensor  # (B, V, 4, 4) blended by the skinning weights: applied to canonical vertices, the posed


@dataclass(frozen=True)
class BodyFit:
    """The body under one scan, as arrays. All transforms are posed_from_canonical.

    ``pose_vertices`` is what a pose encoder sees: the posed body in its root frame (global rotation and translation
    removed), in the mean body shape where the data has it.
    """

    vertices: np.ndarray  # (V, 3)
    vertex_transforms: np.ndarray  # (V, 4, 4)
    joint_transforms: np.ndarray  # (J, 4, 4)
    pose_vertices: np.ndarray  # (V, 3)
    translation: np.ndarray  # (3,)
    pose: np.ndarray | None = None  # (J, 3) axis-angle, radians; None where a dataset lacks it


@dataclass(frozen=True)
class Scan:
    """Oriented points of a dressed person, and what is known of them."""

    points: np.ndarray  # (M, 3) metres
    normals: np.ndarray  # (M, 3) unit
    faces: np.ndarray | None = None  # (F, 3) where the scan is a mesh over its points
    labels: np.ndarray | None = None  # (M,) which surface a point lies on: 0 is skin, then one number a garment
    canonical: np.ndarray | None = None  # (M, 3) true positions at rest in the canonical pose, of simulated garments
    colors: np.ndarray | None = None  # (M, 3) in [0, 1] where the scan is coloured


@dataclass(frozen=True)
class CanonicalScan:
    """A posed scan unposed to the canonical pose: a partial T-pose scan (SCANimate 3.1).

    Points whose triangles were all cut are left out.
    """

    points: np.ndarray  # (M, 3) metres
    normals: np.ndarray  # (M, 3) unit
    weights: np.ndarray  # (M, J) that it was unposed with
    source: np.ndarray  # (M,) index of each point in the posed scan
    faces: np.ndarray | None = None  # (F, 3) without those that were stretched, where the scan is a mesh
    colors: np.ndarray | None = None  # (M, 3) where it has them


@dataclass(frozen=True)
class ClothedTemplate:
    """One outfit at rest in the canonical pose as one mesh: the body's own skin where it is bare, and the garment.

    ``vertices (V, 3)`` metres, ``faces (F, 3)``, ``weights (V, J)`` skinning weights with rows summing to 1,
    ``body_vertex (V,)`` the body's vertex that each skin vertex is, -1 for the garment's, ``covered (V,)`` bool skin
    vertices below the garment. No face joins the two: skin goes on below the garment's edge, and a point cloud of the
    dressed surface takes `visible_faces` alone.
    """

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    body_vertex: np.ndarray
    covered: np.ndarray

    @property
    def garment_faces(self) -> np.ndarray:
        """Which faces ``(F,)`` are garment, bool."""
        return (self.body_vertex[self.faces] < 0).all(axis=1)

    @property
    def garment(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The garment alone: ``vertices (G, 3)``, ``faces (F', 3)``, ``weights (G, J)``; skin comes before it."""
        skin = int((self.body_vertex >= 0).sum())
        return self.vertices[skin:], self.faces[self.garment_faces] - skin, self.weights[skin:]

    @property
    def visible_faces(self) -> np.ndarray:
        """Which faces ``(F,)`` are garment or bare skin, bool: those without a covered vertex."""
        return ~self.covered[self.faces].any(axis=1)


@dataclass(frozen=True)
class Frame:
    """One scan with its body. ``name`` is ``<sequence>.<frame>``, unique within outfit and split."""

    name: str
    outfit: str
    split: str
    body: BodyFit
    scan: Scan


@dataclass(frozen=True)
class SurfaceSamples(Tensors):
    """Points on a triangle mesh."""

    vertex_ids: Tensor  # (N, 3) corner vertices
    barycentric: Tensor  # (N, 3) rows sum to 1
    face_ids: Tensor  # (N,) which triangle each point lies on


@dataclass(frozen=True)
class Batch(Tensors):
    """Frames of one body topology, stacked for training.

    ``canonical`` is True where ``vertices``, ``vertex_transforms`` and scans are those of the canonical pose (training
    in canonical space); ``pose_vertices`` and ``joint_transforms`` are the posed body's all the same.
    """

    pose_vertices: Tensor  # (B, V, 3) encoder input
    vertices: Tensor  # (B, V, 3)
    vertex_transforms: Tensor  # (B, V, 4, 4)
    joint_transforms: Tensor  # (B, J, 4, 4)
    scan_points: Tensor  # (B, M, 3)
    scan_normals: Tensor  # (B, M, 3)
    outfit_ids: Tensor  # (B,) int64 index into the run's outfits
    names: tuple[str, ...]
    canonical: bool = False
    step_outfits: Tensor | None = None  # (O,) of the whole step, ascending, where this is one process's share of it
    frame_ids: Tensor | None = None  # (B,) int64 index into the run's training frames, their mirror images behind them

    @property
    def outfits(self) -> Tensor:
        """The outfits ``(O,)`` that a network encodes for this step, ascending: each once, in whatever share it is."""
        return self.outfit_ids.unique() if self.step_outfits is None else self.step_outfits


@dataclass(frozen=True)
class Prediction:
    """What a point avatar predicts; without explicit template, offsets have no parts to be weighted apart."""

    points: Tensor  # (B, N, 3) posed, metres
    normals: Tensor  # (B, N, 3) unit
    offsets: Tensor  # (B, N, 3) r before the local transform
    garment_offsets: Tensor | None = None  # (B, N, 3) r^g of CloSET eq. 3
    wrinkle_offsets: Tensor | None = None  # (B, N, 3) r^p of CloSET eq. 3
    wrinkle_normals: Tensor | None = None  # (B, N, 3) added by the pose to the garment's, before they are normalised
    codes: Tensor | None = None  # (B, ..., C) garment codes used
    mesh: Tensor | None = None  # (B, V, 3) vertices of a surface of constant topology, where points lie on one


@dataclass(frozen=True)
class LossTerms:
    """Named, weighted loss terms. ``weighted`` sums to the objective; ``raw`` is what the log shows."""

    raw: dict[str, Tensor]
    weighted: dict[str, Tensor]

    @property
    def total(self) -> Tensor:
        """The objective: the sum of the weighted terms."""
        return torch.stack(list(self.weighted.values())).sum()


@dataclass(frozen=True)
class PointCloud:
    """An oriented point cloud on disk or about to be."""

    points: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3)
    colors: np.ndarray | None = None  # (N, 3) in [0, 1]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    colors: np.ndarray | None = None  # (V, 3) in [0, 1]


@dataclass(frozen=True)
class Surface:
    """The dressed surface of one body: oriented points and, where the method has one, a mesh."""

    cloud: PointCloud
    mesh: Mesh | None = None
    constant: bool = False  # whether the mesh has the same faces in every frame


@dataclass(frozen=True)
class Motion:
    """A pose sequence for a 22-joint SMPL-order body."""

    poses: np.ndarray  # (T, J, 3) axis-angle, radians
    translations: np.ndarray  # (T, 3) metres
    fps: float  # frames a second
    name: str
    source: Path | None = None
