"""FITE's npz files: closed scan meshes with SMPL's parameters, and a minimal body in the T-pose."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from avatar.checks import DataError, plain_name
from avatar.data.folders import SPLITS
from avatar.io.documents import read_yaml
from avatar.io.npz import npz_keys, read_arrays
from avatar.io.raw_surface import RawSurface
from avatar.sources.base import SourceFrame, numbered, outfits_at, sorted_frames, subfolders
from avatar.sources.fitted import FittedSource, scan_of_arrays
from avatar.sources.parameters import SmplParameters, parameters_of

PARAMETERS = {"pose": "number ...", "transl": "number ..."}
MESH = {"scan_v": "number V 3", "scan_f": "int F 3"}
POINTS = {"scan_pc": "float M 3", "scan_n": "float M 3"}


class FiteSource(FittedSource):
    """A subject's frames; the scan is the mesh where the file has one, else the points sampled from it."""

    layout = "fite"
    home = "https://github.com/jsnln/fite, whose README says how ReSynth, CAPE or your own scans are packed"
    expected = (
        "  data_scans/<subject>/{train,test}/<frame>.npz          pose, transl, scan_v, scan_f, scan_pc, scan_n\n"
        "  data_templates/<subject>/<subject>_minimal_tpose.ply   minimal body in the T-pose\n"
        "  data_templates/gender_list.yaml                        <subject>: male, female or neutral"
    )

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        candidates = [path, *subfolders(path), *subfolders(path / "data_scans")]
        return outfits_at(folder for folder in candidates if _holds_fite(folder))

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        found = []
        for split in SPLITS:
            for path in sorted((self.path / split).glob("*.npz")):
                found.append(SourceFrame(plain_name(path.stem, "frame"), split, (path,), *numbered(path.stem)))
        return sorted_frames(self.path, found)

    @property
    def _templates(self) -> Path:
        return self.path.resolve().parent.parent / "data_templates"

    @cached_property
    def rest_path(self) -> Path | None:
        subject = self.path.resolve().name
        path = self._templates / subject / f"{subject}_minimal_tpose.ply"
        return path if path.is_file() else None

    @cached_property
    def gender(self) -> str:
        path = self._templates / "gender_list.yaml"
        return str(read_yaml(path).get(self.path.resolve().name, "")) if path.is_file() else ""

    def parameters(self, frame: SourceFrame) -> SmplParameters:
        return parameters_of(frame.files[0], read_arrays(frame.files[0], PARAMETERS))

    def scan(self, frame: SourceFrame) -> RawSurface:
        stored = read_arrays(frame.files[0], {}, MESH | POINTS)
        if MESH.keys() <= stored.keys():
            return scan_of_arrays(frame.files[0], stored["scan_v"], stored["scan_f"].astype("int64"))
        if POINTS.keys() <= stored.keys():
            return scan_of_arrays(frame.files[0], stored["scan_pc"], normals=stored["scan_n"])
        problem = "expected scan_v and scan_f, or scan_pc and scan_n: it holds a pose without a scan."
        hint = "Hint: skip_invalid=true leaves it out; predict takes such poses with motion=."
        raise DataError(frame.files[0], problem, hint)


def _holds_fite(folder: Path) -> bool:
    """Whether a folder has FITE's frames, poses to predict alone included."""
    path = next((path for split in SPLITS for path in sorted((folder / split).glob("*.npz"))), None)
    if path is None or (folder / "outfit.yaml").is_file():
        return False
    keys = npz_keys(path)
    return {"pose", "transl"} <= keys and ("scan_v" in keys or "scan_pc" in keys)
