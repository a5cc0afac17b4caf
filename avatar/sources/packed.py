"""POP's packed CAPE and ReSynth: one npz a frame, and SkiRT's second tree of npz files beside it."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from avatar.body.packed import holds_template
from avatar.body.smpl import converted_kind
from avatar.checks import DataError
from avatar.data.folders import SPLITS
from avatar.data.packed_layout import template_of_mesh
from avatar.io.npz import naming, npz_keys, read_arrays
from avatar.io.raw_surface import RawSurface
from avatar.records import Template
from avatar.sources.base import PosedScan, SourceFrame, numbered, outfits_at, sorted_frames, subfolders
from avatar.sources.fitted import FittedSource, minimal_body, scan_of_arrays
from avatar.sources.parameters import SmplParameters, parameters_of

SCAN = {"scan_pc": "float M 3", "scan_n": "float M 3"}
BODY = {"body_verts": "float V 3", "vtransf": "float V 3 3 | V 4 4"}
EXTRA = {"mean_body_v": "float V 3 | 1 V 3", "body_pose": "number ..."}
EXTRA_FOLDERS = ("extra", "extras", "packed_extra", "extra_data")
MEAN_APART = 0.3  # metres between subject and mean shape in one pose at 99% of the vertices; others are farther off


class PackedSource(FittedSource):
    """An outfit of POP's packed frames.

    With ``body.path`` and poses (SkiRT's, in ``fits`` or in a tree ``extra`` beside ``packed``) it can be posed; the
    minimal body is ``minimal_body_shape/<subject>.obj`` or ``template.obj``. Without a model there is its mesh alone.
    """

    layout = "packed"
    kind = "smplx"
    home = "https://pop.is.tue.mpg.de (ReSynth) and https://cape.is.tue.mpg.de (CAPE), after registration"
    expected = (
        "  [packed/]<outfit>/{train,test}/<sequence>.<frame>.npz   scan_pc, scan_n, body_verts, vtransf\n"
        "  minimal_body_shape/<subject>.obj                        the minimal body in its T-pose, or template.obj\n"
        "  extra/<outfit>/{train,test}/<the same names>.npz        SkiRT's, optional: body_pose, mean_body_v"
    )

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        candidates = [path, *subfolders(path), *subfolders(path / "packed")]
        return outfits_at(folder for folder in candidates if _holds_packed(folder))

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        found = []
        for split in SPLITS:
            for path in sorted((self.path / split).glob("*.npz")):
                files = (path, *filter(None, [self._extra(path)]))
                found.append(SourceFrame(path.stem, split, files, *numbered(path.stem)))
        return sorted_frames(self.path, found)

    @cached_property
    def rest_path(self) -> Path | None:
        root = self.path.parent.parent if self.path.parent.name == "packed" else self.path.parent
        subject = self.name.partition("_")[0]  # of CAPE's outfits; ReSynth's are subjects of their own
        names = [self.name, *([subject] if subject.isdigit() else [])]
        given = (folder / "template.obj" for folder in (self.path, root) if (folder / "template.obj").is_file())
        shapes = (minimal_body(folder, name) for folder in (root, root.parent) for name in names)
        return next(filter(None, (*given, *shapes)), None)

    @cached_property
    def keeps_hands(self) -> bool:
        asked, path = self.config.body.all_joints, self.config.body.path
        return converted_kind(path) == "smpl" if asked is None and not holds_template(path) else bool(asked)

    @property
    def body_hint(self) -> str:
        place = self.path / "template.obj"
        return f"Hint: put the minimal body's mesh in its T-pose there as {place}, or give body.path=."

    @cached_property
    def mesh_template(self) -> Template | None:
        if self.rest_path is None or self.rest_path.suffix == ".npy":
            return None
        return template_of_mesh(self.rest_path)

    def parameters(self, frame: SourceFrame) -> SmplParameters:
        if len(frame.files) < 2:
            raise DataError(frame.files[0], "expected SkiRT's file of this frame, there is none.")
        return parameters_of(frame.files[1], read_arrays(frame.files[1], {"body_pose": "number ..."}))

    def scan(self, frame: SourceFrame) -> RawSurface:
        stored = read_arrays(frame.files[0], SCAN)
        return scan_of_arrays(frame.files[0], stored["scan_pc"], normals=stored["scan_n"])

    def read(self, frame: SourceFrame) -> PosedScan:
        stored = read_arrays(frame.files[0], {}, BODY)
        posed, seen = stored.get("body_verts"), None
        extra = read_arrays(frame.files[1], {}, EXTRA) if len(frame.files) > 1 else {}
        pose = None
        if "body_pose" in extra and self.body is not None:
            with naming(frame.files[1]):
                pose = self.parameters(frame).pose_of(self.body, cut=not self.keeps_hands)
        if "mean_body_v" in extra and posed is not None:
            seen = _mean_vertices(frame.files[1], extra["mean_body_v"], posed)
        return PosedScan(self.scan(frame), pose, None, posed, stored.get("vtransf"), pose_vertices=seen)

    def _extra(self, path: Path) -> Path | None:
        """SkiRT's file of the same frame."""
        below = path.relative_to(self.path.parent)
        roots = [self.path.parent.parent / name for name in EXTRA_FOLDERS]
        roots = roots if self.config.fits is None else [self.config.fits, self.config.fits / "packed"]
        return next((root / below for root in roots if (root / below).is_file()), None)


def _holds_packed(folder: Path) -> bool:
    """Whether a folder is an outfit of packed frames that is not one of this project's own."""
    path = next((path for split in SPLITS for path in (folder / split).glob("*.npz")), None)
    if path is None or (folder / "outfit.yaml").is_file():
        return False
    keys = npz_keys(path)
    return "scan_pc" in keys and not keys & {"scan_v", "transl"}  # those of FITE


def _mean_vertices(path: Path, mean: np.ndarray, posed: np.ndarray) -> np.ndarray:
    """The posed body of mean shape ``(V, 3)``; raises `DataError` for one in another pose than ``posed (V, 3)``."""
    mean = mean.reshape(-1, 3)
    if mean.shape != posed.shape:
        raise DataError(path, f"mean_body_v: expected shape {posed.shape} as body_verts, got {mean.shape}.")
    centred = (mean - mean.mean(axis=0)) - (posed - posed.mean(axis=0))
    apart = float(np.quantile(np.linalg.norm(centred, axis=1), 0.99))
    if apart > MEAN_APART:
        hint = "Hint: is it of the same frame, and posed?"
        raise DataError(path, f"mean_body_v: expected the pose of body_verts, it lies {apart:.2f} m away.", hint)
    return mean
