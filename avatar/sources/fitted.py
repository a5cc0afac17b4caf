"""Outfits whose scans come with fitted SMPL-family parameters; the body model's file is the user's own."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from avatar.body.model import BodyModel
from avatar.body.packed import holds_template
from avatar.body.registry import body_of_file, canonical_pose
from avatar.body.smpl import smpl_body, way_to_file
from avatar.checks import AvatarError, DataError
from avatar.geometry.units import METRES, guess_unit
from avatar.io.meshes import read_mesh
from avatar.io.npz import naming, read_npy
from avatar.io.raw_surface import RawSurface
from avatar.io.surfaces import check_surface
from avatar.sources.base import PosedScan, Source, SourceConfig, SourceFrame
from avatar.sources.parameters import SmplParameters

SPREAD = 0.5  # standard deviations between the shapes of one person's fits that are worth a warning
MINIMAL = (".npy", ".obj", ".ply")
log = logging.getLogger(__name__)


class FittedSource(Source):
    """An outfit of scans with SMPL-family parameters; body and scan have the same axes and, but for a unit, origin.

    The body is ``body.path`` in the shape of ``body.betas``, else of the layout's minimal T-pose mesh (`rest_path`),
    else of the mean of the fits' own betas; without ``body.path`` there is none, and scans are read without a pose.
    Raises `AvatarError` for another ``up`` than y; `DataError` for a model whose shape nothing says.
    """

    kind: ClassVar[str] = "smpl"  # the model that was fitted

    def __init__(self, path: Path, name: str, config: SourceConfig):
        super().__init__(path, name, config)
        if config.up not in ("auto", "y"):
            problem = (
                f"up: expected auto or y, as layout {self.layout} keeps scans in their body's axes, got {config.up}."
            )
            raise AvatarError(problem)

    @abstractmethod
    def parameters(self, frame: SourceFrame) -> SmplParameters:
        """The body's parameters of a frame."""

    @abstractmethod
    def scan(self, frame: SourceFrame) -> RawSurface:
        """The scan of a frame in its own unit."""

    def vertices(self, frame: SourceFrame) -> np.ndarray | None:
        """The posed body's own mesh ``(V, 3)``, metres, where the layout has one."""
        return None

    def labels(self, frame: SourceFrame) -> np.ndarray | None:
        """Which garment each of the scan's vertices is of ``(M,)``, where the layout says."""
        return None

    @property
    def rest_path(self) -> Path | None:
        """The file of this person's minimal body in the T-pose; None where there is none."""
        return None

    @property
    def gender(self) -> str:
        """The gender of the model that was fitted; empty where nothing says it."""
        return ""

    @cached_property
    def keeps_hands(self) -> bool:
        """Whether hands and face are posed: as ``body.all_joints`` says, else where the fits' can be read."""
        if self.config.body.all_joints is not None:
            return self.config.body.all_joints
        try:
            next(self._valid_parameters()).with_fingers(self.config.body.path)
        except DataError as error:
            log.warning("%s: hands and face are laid at rest. %s", self.path, error)
            return False
        return True

    @cached_property
    def betas(self) -> list[float]:
        """The mean of the fits' shapes; empty where they have none."""
        shapes = [parameters.betas for parameters in self._valid_parameters()]
        if len({len(shape) for shape in shapes}) != 1:
            problem = "betas: expected equally many in all fits, got others."
            raise DataError(self.path, problem, "Hint: give body.betas.")
        mean = np.mean(shapes, axis=0)
        if mean.size and (spread := float(np.abs(shapes - mean).max())) > SPREAD:
            log.warning("%s: shapes differ by up to %.1f from their mean, which is taken.", self.path, spread)
        return mean.tolist()

    def _valid_parameters(self) -> Iterator[SmplParameters]:
        """The parameters of every frame that has valid ones; raises the first error where none has."""
        errors, valid = [], 0
        for frame in self.frames:
            try:
                parameters = self.parameters(frame)
            except DataError as error:
                errors.append(error)
            else:
                valid += 1
                yield parameters
        if not valid:
            raise errors[0] if errors else DataError(self.path, "expected scans, there are none.")

    @property
    def body_hint(self) -> str:
        fitted = f"{self.gender} {self.kind}".strip()
        return f"Hint: its fits pose a body of kind {fitted}. {way_to_file(self.kind)}, and give body.path=<file.npz>."

    @cached_property
    def body(self) -> BodyModel | None:
        config = self.config.body
        if config.path is None:
            return None
        if config.path.suffix != ".npz" or holds_template(config.path):
            return body_of_file(config.path, {"canonical": config.canonical}, "body.")
        rest = None if config.betas else self.rest_path
        betas = config.betas or ([] if rest else self.betas)
        if rest is None and not betas:
            problem = "expected this person's shape: a minimal body in the T-pose, betas of the fits or body.betas="
            raise self.missing(self.path, f"{problem}, there is none.")
        hint = "Hint: body.path must be the kind of model that was fitted: SMPL has 6890 vertices, SMPL-X 10475."
        with naming(rest or config.path, hint if rest else ""):
            vertices = None if rest is None else read_rest(rest)
            body = smpl_body(config.path, betas, self.keeps_hands, vertices=vertices)
            return body.with_canonical_pose(canonical_pose(config.canonical, body.joint_names))

    @property
    def body_files(self) -> tuple[Path, ...]:
        return tuple(path for path in (self.config.body.path, self.rest_path) if path is not None)

    def read(self, frame: SourceFrame) -> PosedScan:
        parameters, scan = self.parameters(frame), self.scan(frame)
        unit = self.config.units
        if unit == "auto":
            unit = self.unit_of(scan) if parameters.scale == 1 else "m"  # a fitted scale is all there is to the unit
        pose = translation = vertices = None
        if self.body is not None:
            parameters = parameters.with_fingers(self.config.body.path) if self.keeps_hands else parameters
            with naming(frame.files[-1]):
                pose = parameters.pose_of(self.body, cut=not self.keeps_hands)
            translation = parameters.translation.astype(np.float32)
            vertices = self.vertices(frame) if self.keeps_hands else None
        moved = scan.vertices.astype(np.float64) * (METRES[unit] / parameters.scale)
        return PosedScan(
            scan=replace(scan, vertices=moved.astype(np.float32)),
            pose=pose,
            translation=translation,
            vertices=None if vertices is None else vertices / np.float32(parameters.scale),
            labels=self.labels(frame),
        )

    def unit_of(self, scan: RawSurface) -> str:
        """The unit of a scan where ``units`` says auto: metres, unless a layout has others."""
        return "m"


def guessed_unit(scan: RawSurface) -> str:
    """The unit in which a scan is as tall as a person; `DataError` where there is none."""
    unit = guess_unit(scan.height)
    if unit is None:
        problem = f"expected a person's height in m, cm, mm or in, got a scan of {scan.height:.4g}."
        raise DataError(scan.path, problem, "Hint: give units=.")
    return unit


def read_rest(path: Path) -> np.ndarray:
    """The vertices ``(V, 3)`` float64 of a minimal body in the T-pose, from an npy file or a mesh."""
    vertices = read_npy(path, "float V 3") if path.suffix == ".npy" else read_mesh(path).vertices
    return vertices.astype(np.float64)


def minimal_body(root: Path, subject: str) -> Path | None:
    """A subject's minimal body in the T-pose below ``minimal_body_shape``; None where there is none."""
    folder = root / "minimal_body_shape"
    files = [path for path in sorted(folder.rglob("*")) if path.suffix in MINIMAL and path.is_file()]
    return next((path for path in files if subject in path.relative_to(folder).as_posix()), None)


def scan_of_arrays(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    colors: np.ndarray | None = None,
) -> RawSurface:
    """A scan of a file's arrays, checked as scans of mesh files are."""
    return check_surface(RawSurface(path, vertices, faces, normals, colors))


def parameter_file(folder: Path, stem: str, formats: tuple[str, ...]) -> Path | None:
    """The file of a frame's body parameters in a folder, of the first format that is there."""
    paths = (folder / f"{stem}{suffix}" for suffix in formats)
    return next((path for path in paths if path.is_file()), None)
