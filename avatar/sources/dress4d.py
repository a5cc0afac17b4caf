"""4D-DRESS: takes of scans, bodies and labels as pickles, which are read without running anything of them."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from avatar.body.inert_pickle import read_pickled_arrays
from avatar.body.packed import holds_template
from avatar.body.smpl import converted_kind
from avatar.checks import DataError, plain_name
from avatar.io.meshes import read_mesh
from avatar.io.raw_surface import RawSurface, scale_colors
from avatar.sources.base import SourceFrame, numbered, sorted_frames, subfolders
from avatar.sources.fitted import FittedSource, scan_of_arrays
from avatar.sources.parameters import SmplParameters, read_parameters

SCANS, LABELS = "Meshes_pkl", Path("Semantic", "labels")
FITS = {"smplx": "SMPLX", "smpl": "SMPL"}  # folders of the kinds of body


class Dress4dSource(FittedSource):
    """A subject's Inner or Outer outfit; each take is a sequence. Labels keep the data set's own numbers.

    Bodies are SMPL-X's, or SMPL's where ``body.path`` is such a file.
    """

    layout = "dress4d"
    kind = "smplx"
    home = "https://4d-dress.ait.ethz.ch, by its request form"
    expected = (
        "  <subject>/<Inner|Outer>/<Take>/Meshes_pkl/mesh-f<frame>.pkl          vertices, faces, colors, normals\n"
        "  <subject>/<Inner|Outer>/<Take>/SMPLX/mesh-f<frame>_smplx.{pkl,ply}   parameters and posed body; or SMPL/\n"
        "  <subject>/<Inner|Outer>/<Take>/Semantic/labels/label-f<frame>.pkl    optional: scan_labels\n"
        "  <subject>/<Inner|Outer>/<Take>/basic_info.pkl                        optional: gender"
    )

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        inside = [folder for subject in (path, *subfolders(path)) for folder in subfolders(subject)]
        outfits = [folder for folder in (path, *inside) if any(map(_scans, subfolders(folder)))]
        return {
            plain_name("_".join(folder.resolve().parts[-2:]), "outfit"): folder for folder in dict.fromkeys(outfits)
        }

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        found = []
        for take in subfolders(self.path):
            for path in _scans(take):
                number = path.stem.removeprefix("mesh-")  # f00011
                fits = take / FITS[self._fitted] / f"{path.stem}_{self._fitted}.pkl"
                others = [fits.with_suffix(".ply"), take / LABELS / f"label-{number}.pkl", fits]
                files = (path, *(file for file in others if file.is_file()))
                count = numbered(number)[1]
                name = plain_name(f"{take.name}.{count:05d}", "frame")
                found.append(SourceFrame(name, "", files, take.name, count))
        return sorted_frames(self.path, found)

    @cached_property
    def _fitted(self) -> str:
        """The kind of body that is read: that of ``body.path``, else SMPL-X."""
        path = self.config.body.path
        kind = self.kind if path is None or holds_template(path) else converted_kind(path)
        if kind not in FITS:
            raise DataError(path, f"expected an smplx or smpl body model, got {kind}.")
        return kind

    @cached_property
    def gender(self) -> str:
        path = self.path / self.frames[0].sequence / "basic_info.pkl"
        found = read_pickled_arrays(path, (), ("gender",)) if path.is_file() else {}
        return str(found.get("gender", ""))

    def parameters(self, frame: SourceFrame) -> SmplParameters:
        if not frame.files[-1].stem.endswith(self._fitted):
            name = f"{frame.files[0].stem}_{self._fitted}.pkl"
            raise DataError(
                frame.files[0], f"expected the body's parameters in {FITS[self._fitted]}/{name}, there are none."
            )
        return read_parameters(frame.files[-1])

    def scan(self, frame: SourceFrame) -> RawSurface:
        path = frame.files[0]
        stored = read_pickled_arrays(path, ("vertices", "faces"), ("normals", "colors"))
        colors = stored.get("colors")
        if colors is not None:
            colors = scale_colors(path, colors[..., :3])[0]  # without the fourth channel, which is opaque
        faces = stored["faces"].astype(np.int64)
        return scan_of_arrays(path, stored["vertices"], faces, stored.get("normals"), colors)

    def vertices(self, frame: SourceFrame) -> np.ndarray | None:
        path = next((file for file in frame.files if file.suffix == ".ply"), None)
        return None if path is None else read_mesh(path).vertices

    def labels(self, frame: SourceFrame) -> np.ndarray | None:
        path = next((file for file in frame.files if file.name.startswith("label-")), None)
        if path is None:
            return None
        labels = read_pickled_arrays(path, ("scan_labels",))["scan_labels"].reshape(-1)
        if not ((labels >= 0) & (labels <= 255) & (labels == np.floor(labels))).all():
            raise DataError(
                path, f"scan_labels: expected whole numbers from 0 to 255, got {labels.min()} to {labels.max()}."
            )
        return labels.astype(np.uint8)


def _scans(take: Path) -> list[Path]:
    return sorted((take / SCANS).glob("mesh-*.pkl"))
