"""The open dataset's layout, whose compact simulated frames are scanned when loaded; and opening any outfit."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from avatar.body.model import BodyModel
from avatar.body.open import MEAN_SHAPE, open_body
from avatar.body.packed import packed_body
from avatar.body.registry import canonical_pose
from avatar.checks import DataError
from avatar.data.folders import outfit_folder, read_outfit_settings
from avatar.data.outfits import Outfit
from avatar.data.packed_layout import PackedOutfit
from avatar.data.scanner import DressedSurface, ScanConfig, fuse_mesh, paint, scan_mesh, scan_points
from avatar.io.frames import OpenGarment, read_canonical_scan, read_open_frame, read_open_garment
from avatar.io.npz import naming
from avatar.records import BodyFit, Frame, Scan, Template


class OpenOutfit(Outfit):
    """An outfit of the open dataset: ``outfit.yaml``, ``garment.npz`` and frames of cloth and visibility."""

    def __init__(self, path: Path, dataset: str = "", scanner: ScanConfig | None = None):
        super().__init__(path, dataset)
        self.scanner = scanner or ScanConfig()
        settings = read_outfit_settings(self.path)
        body = settings.get("body") if isinstance(settings.get("body"), dict) else {}
        named = body.get("model") == "open" and isinstance(body.get("shape"), str)
        if not named and body.get("model") != "packed":
            expected = "{model: open, shape, canonical} or {model: packed, canonical} with a body.npz"
            raise DataError(self.path / "outfit.yaml", f"body: expected {expected}, got {settings.get('body')}.")
        self._shape: str | None = body["shape"] if named else None  # of the open body; None: body.npz is the subject
        self._canonical = str(body.get("canonical", "t"))

    @cached_property
    def garment(self) -> OpenGarment:
        """The cloth's topology, its rest in the canonical pose and its labels."""
        return read_open_garment(self.path / "garment.npz")

    @cached_property
    def body(self) -> BodyModel:
        if self._shape is not None:
            return self._make_body(self._shape)
        path = self.path / "body.npz"
        body = packed_body(path)
        if not torch.equal(body.faces, self.mean_body.faces):
            raise DataError(path, "faces: expected those of the open body.", "Make the body with tools/make_body.py.")
        return body.with_canonical_pose(self.mean_body.canonical_pose)

    @cached_property
    def mean_body(self) -> BodyModel:
        """The mean of all open shapes, in the same canonical space."""
        return self._make_body(MEAN_SHAPE)

    def _make_body(self, shape: str) -> BodyModel:
        with naming(self.path / "outfit.yaml", prefix="body: "):
            body = open_body(shape)
            return body.with_canonical_pose(canonical_pose(self._canonical, body.joint_names))

    def _read_template(self) -> Template:
        return self.body.template

    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        body, surface = self._dress(path)
        scan = fuse_mesh if self.scanner.mesh else scan_points
        return Frame(name, self.name, split, body, scan(surface, self.scanner, f"{self.name}/{name}"))

    def resample(self, split: str, name: str, points: int, seed: int) -> Scan:
        """A fresh, perfect sampling of a frame's visible surface, independent of the scanner's noise and holes."""
        config = ScanConfig(points=points, seed=seed, pattern=self.scanner.pattern)
        return scan_points(self.load_surface(split, name), config, f"{self.name}/{name}/again")

    def load_mesh(self, split: str, name: str) -> Scan:
        """What can be seen of a frame as a perfect mesh: a scan with faces, labels and canonical positions."""
        return paint(scan_mesh(self.load_surface(split, name)), self.scanner.pattern)

    def load_body(self, split: str, name: str) -> BodyFit:
        """The body under a frame, without its scan."""
        return self._dress(self.frame_path(split, name))[0]

    def load_surface(self, split: str, name: str) -> DressedSurface:
        """Body and cloth of a frame as one labelled mesh with its visible faces."""
        return self._dress(self.frame_path(split, name))[1]

    def _dress(self, path: Path) -> tuple[BodyFit, DressedSurface]:
        """The posed body of a frame's file, and body and cloth as one mesh."""
        stored, template, garment = read_open_frame(path), self.template, self.garment
        expected = {
            "pose": (len(self.body.parents), 3),
            "cloth": garment.canonical.shape,
            "visible_body": (len(self.body.faces),),
            "visible_cloth": (len(garment.faces),),
        }
        for key, shape in expected.items():
            if getattr(stored, key).shape != shape:
                problem = f"{key}: expected {shape} as body and garment.npz have it, got {getattr(stored, key).shape}."
                raise DataError(path, problem, "Frame and garment are of different outfits.")
        body = self.fit_pose(stored.pose, stored.translation)
        parts = {
            "vertices": (body.vertices, stored.cloth),
            "canonical": (template.vertices.numpy(), garment.canonical),
            "faces": (template.faces.numpy(), garment.faces + len(body.vertices)),
            "visible": (stored.visible_body, stored.visible_cloth),
            "labels": (np.zeros(len(body.vertices), np.uint8), garment.labels),
        }
        surface = {name: torch.from_numpy(np.concatenate(pair)) for name, pair in parts.items()}
        return body, DressedSurface(**surface)


class CanonicalOutfit(Outfit):
    """The frames of an outfit in its canonical space (SCANimate 3.1); their scans are ``<scans>/<split>/<frame>.npz``.

    A frame's body stands at rest under its scan, with identity vertex transforms. What tells the pose stays that of the
    posed frame: ``pose_vertices``, ``joint_transforms``, ``pose``.
    """

    measured = False

    def __init__(self, posed: Outfit, scans: Path):
        super().__init__(posed.path, posed.dataset)
        self.posed, self.scans = posed, Path(scans)

    @property
    def body(self) -> BodyModel | None:
        return self.posed.body

    @property
    def mean_body(self) -> BodyModel | None:
        return self.posed.mean_body

    def frame_path(self, split: str, name: str) -> Path:
        return self.scans / split / super().frame_path(split, name).name

    @cached_property
    def _still(self) -> np.ndarray:
        """A vertex transform that moves nothing for each vertex, ``(V, 4, 4)``; one array for all frames."""
        return np.tile(np.eye(4, dtype=np.float32), (len(self.template.vertices), 1, 1))

    def _read_template(self) -> Template:
        return self.posed.template

    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        if not path.is_file():
            raise DataError(path, "no canonical scan of this frame.", "Run tools/canonicalize.py to its end.")
        stored, posed = read_canonical_scan(path), self.posed.load(split, name)
        body = replace(posed.body, vertices=self.template.vertices.numpy(), vertex_transforms=self._still)
        return replace(posed, body=body, scan=Scan(stored.points, stored.normals, stored.faces, colors=stored.colors))


LAYOUTS = ("open", "packed")


def find_outfit(root: Path, dataset: str, outfit: str, scanner: ScanConfig | None = None) -> Outfit:
    """An outfit by the names of its data set and its own (`outfit_folder`); simulated frames are seen by a scanner.

    Raises `AvatarError` for names that could leave the data root; `DataError` for what is not there, or invalid.
    """
    return open_outfit_folder(outfit_folder(root, dataset, outfit), dataset, scanner)


def open_outfit_folder(path: Path, dataset: str = "", scanner: ScanConfig | None = None) -> Outfit:
    """An outfit by its folder, of the layout that ``outfit.yaml`` says or its files show; `DataError` for another."""
    path = Path(path)
    shown = "open" if (path / "garment.npz").is_file() else "packed"
    layout = read_outfit_settings(path).get("layout", shown)
    if layout not in LAYOUTS:
        raise DataError(path / "outfit.yaml", f"layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}.")
    return OpenOutfit(path, dataset, scanner) if layout == "open" else PackedOutfit(path, dataset)
