"""The records that cross module borders. Letters: B batch, N points, M scan points, V vertices, F faces, J joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

Record = TypeVar("Record")


def map_tensors(record: Record, change: Callable[[Tensor], Tensor]) -> Record:
    """The same record with each of its tensors changed by a function; what is no tensor stays."""
    values = {field.name: getattr(record, field.name) for field in fields(record)}
    return replace(record, **{name: change(value) for name, value in values.items() if isinstance(value, Tensor)})


@dataclass(frozen=True)
class Template:
    """A body at rest in its canonical pose: metres, right-handed, y up, facing +z.

    ``vertices (V, 3)``, ``faces (F, 3)`` int64, ``weights (V, J)`` skinning weights with rows summing to 1,
    ``joints (J, 3)`` joint positions in the canonical pose, ``parents`` with -1 for the root and every parent
    before its children, ``joint_names``. ``canonical_from_bind (J, 4, 4)`` is each joint's rigid motion from the
    pose in which the weights were painted, or None where that pose is the canonical one; `skin_transforms` needs it.
    ``uv (U, 2)`` in [0, 1] and ``uv_faces (F, 3)``, each corner's index into it, are None for a body without atlas.
    """

    vertices: Tensor
    faces: Tensor
    weights: Tensor
    joints: Tensor
    parents: tuple[int, ...]
    joint_names: tuple[str, ...]
    canonical_from_bind: Tensor | None = None
    uv: Tensor | None = None
    uv_faces: Tensor | None = None

    def to(self, *args, **kwargs) -> Template:
        """The same template with its floating-point tensors moved or cast, and its faces moved only."""
        names = ("vertices", "weights", "joints", "canonical_from_bind", "uv")
        moved = {name: getattr(self, name).to(*args, **kwargs) for name in names if getattr(self, name) is not None}
        device = moved["vertices"].device
        whole = {name: getattr(self, name) for name in ("faces", "uv_faces")}
        return replace(self, **moved, **{name: ids if ids is None else ids.to(device) for name, ids in whole.items()})


@dataclass(frozen=True)
class PosedBody:
    """A batch of posed bodies. All transforms are posed_from_canonical.

    ``vertices (B, V, 3)``, ``joint_transforms (B, J, 4, 4)`` rigid, ``vertex_transforms (B, V, 4, 4)`` blended
    by the skinning weights, so that a vertex's posed position is its transform applied to its canonical one.
    """

    vertices: Tensor
    joint_transforms: Tensor
    vertex_transforms: Tensor


@dataclass(frozen=True)
class BodyFit:
    """The body under one scan, as arrays. ``pose`` (axis-angle, radians) is None where a dataset lacks it.

    ``vertices (V, 3)``, ``vertex_transforms (V, 4, 4)`` and ``joint_transforms (J, 4, 4)`` posed_from_canonical,
    ``pose (J, 3) | None``, ``translation (3,)``.

    ``pose_vertices (V, 3)`` is what a pose encoder sees: the posed body in its root frame (global rotation and
    translation removed), in the mean body shape where the data has it.
    """

    vertices: np.ndarray
    vertex_transforms: np.ndarray
    joint_transforms: np.ndarray
    pose_vertices: np.ndarray
    translation: np.ndarray
    pose: np.ndarray | None = None


@dataclass(frozen=True)
class Scan:
    """Oriented points of a dressed person, and what is known of them.

    ``points (M, 3)`` metres, ``normals (M, 3)`` unit; ``faces (F, 3)`` where the scan is a mesh over its points;
    ``labels (M,)`` which surface a point lies on (0 is skin, then one number a garment); ``canonical (M, 3)`` the
    point's true position on the garment at rest in the canonical pose (simulated data only); ``colors (M, 3)`` in
    [0, 1] where the scan is coloured.
    """

    points: np.ndarray
    normals: np.ndarray
    faces: np.ndarray | None = None
    labels: np.ndarray | None = None
    canonical: np.ndarray | None = None
    colors: np.ndarray | None = None


@dataclass(frozen=True)
class CanonicalScan:
    """A posed scan unposed to the canonical pose: a partial T-pose scan (SCANimate 3.1).

    ``points (M, 3)`` metres, ``normals (M, 3)`` unit, ``weights (M, J)`` the skinning weights it was unposed with,
    ``faces (F, 3)`` without those that were stretched where the scan is a mesh, ``colors (M, 3)`` where it has them.
    Points whose triangles were all cut are left out; ``source (M,)`` is the index of each in the posed scan.
    """

    points: np.ndarray
    normals: np.ndarray
    weights: np.ndarray
    source: np.ndarray
    faces: np.ndarray | None = None
    colors: np.ndarray | None = None


@dataclass(frozen=True)
class ClothedTemplate:
    """One outfit at rest in the canonical pose as one mesh: the body's own skin where it is bare, and the garment.

    ``vertices (V, 3)`` metres, ``faces (F, 3)``, ``weights (V, J)`` skinning weights with rows summing to 1,
    ``body_vertex (V,)`` the body's vertex that each skin vertex is, -1 for the garment's. No face joins the two: skin
    goes on below the garment's edge.
    """

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    body_vertex: np.ndarray

    @property
    def garment_faces(self) -> np.ndarray:
        """Which faces ``(F,)`` are garment, bool."""
        return (self.body_vertex[self.faces] < 0).all(axis=1)


@dataclass(frozen=True)
class Frame:
    """One scan with its body. ``name`` is ``<sequence>.<frame>``, unique within outfit and split."""

    name: str
    outfit: str
    split: str
    body: BodyFit
    scan: Scan


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on a triangle mesh: ``vertex_ids (N, 3)`` corner vertices, ``barycentric (N, 3)`` rows summing to 1.

    ``face_ids (N,)`` says which triangle each point lies on.
    """

    vertex_ids: Tensor
    barycentric: Tensor
    face_ids: Tensor

    def to(self, *args, **kwargs) -> SurfaceSamples:
        """The same samples with weights moved or cast, and indices moved only."""
        barycentric = self.barycentric.to(*args, **kwargs)
        device = barycentric.device
        return SurfaceSamples(self.vertex_ids.to(device), barycentric, self.face_ids.to(device))


@dataclass(frozen=True)
class Batch:
    """Frames of one body topology, stacked for training.

    ``pose_vertices (B, V, 3)`` encoder input, ``vertices (B, V, 3)`` posed body, ``vertex_transforms
    (B, V, 4, 4)``, ``joint_transforms (B, J, 4, 4)``, ``scan_points (B, M, 3)``, ``scan_normals (B, M, 3)``,
    ``outfit_ids (B,)`` int64 index into the run's outfits, ``names``. ``canonical`` is True where ``vertices``,
    ``vertex_transforms`` and scans are those of the canonical pose (training in canonical space); what tells the
    pose, ``pose_vertices`` and ``joint_transforms``, is the posed body's all the same. ``step_outfits (O,)`` are the
    outfits of the whole step, ascending, where this batch is one process's share of it (None: it is all of it).
    """

    pose_vertices: Tensor
    vertices: Tensor
    vertex_transforms: Tensor
    joint_transforms: Tensor
    scan_points: Tensor
    scan_normals: Tensor
    outfit_ids: Tensor
    names: tuple[str, ...]
    canonical: bool = False
    step_outfits: Tensor | None = None

    @property
    def outfits(self) -> Tensor:
        """The outfits ``(O,)`` that a network encodes for this step, ascending: each once, in whatever share it is."""
        return self.outfit_ids.unique() if self.step_outfits is None else self.step_outfits

    def to(self, device: torch.device | str) -> Batch:
        """The same batch on another device."""
        return map_tensors(self, lambda tensor: tensor.to(device))


@dataclass(frozen=True)
class Prediction:
    """What a point avatar predicts.

    ``points (B, N, 3)`` posed, metres; ``normals (B, N, 3)`` unit; ``offsets (B, N, 3)`` r before the local
    transform; ``garment_offsets`` and ``wrinkle_offsets`` its two parts (CloSET eq. 3; None for a method without
    explicit template, whose r has no parts to be weighted apart); ``wrinkle_normals (B, N, 3)`` what the pose adds to
    the garment's normals before they are normalised, or None; ``codes`` the garment codes used ``(B, ..., C)`` or None.
    """

    points: Tensor
    normals: Tensor
    offsets: Tensor
    garment_offsets: Tensor | None = None
    wrinkle_offsets: Tensor | None = None
    wrinkle_normals: Tensor | None = None
    codes: Tensor | None = None


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
    """An oriented point cloud on disk or about to be: ``points (N, 3)``, ``normals (N, 3)``.

    ``colors (N, 3)`` in [0, 1] where it has them.
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray | None = None


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: ``vertices (V, 3)``, ``faces (F, 3)``, optional ``colors (V, 3)`` in [0, 1]."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None


@dataclass(frozen=True)
class Surface:
    """The dressed surface of one body: oriented points and, where the method has one, a mesh.

    ``constant`` is True where the mesh has the same faces in every frame.
    """

    cloud: PointCloud
    mesh: Mesh | None = None
    constant: bool = False


@dataclass(frozen=True)
class Motion:
    """A pose sequence for a 22-joint SMPL-order body.

    ``poses (T, J, 3)`` axis-angle, radians; ``translations (T, 3)`` metres; ``fps`` frames per second; ``name``.
    """

    poses: np.ndarray
    translations: np.ndarray
    fps: float
    name: str
    source: Path | None = None
