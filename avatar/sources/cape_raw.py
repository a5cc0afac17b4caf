"""CAPE's raw release: registered meshes of clothed people, one npz a frame, and scans in millimetres beside them."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path

from avatar.checks import plain_name
from avatar.io.npz import npz_keys, read_arrays
from avatar.io.raw_surface import RawSurface
from avatar.io.surfaces import read_surface
from avatar.sources.base import SourceFrame, numbered, sorted_frames, subfolders
from avatar.sources.fitted import FittedSource, minimal_body, scan_of_arrays
from avatar.sources.parameters import SmplParameters, parameters_of

KEYS = {"pose": "number ...", "transl": "number ..."}
SEQUENCES = ("sequences", "scans")  # POP's ground truth is called scans
MISTAKEN = re.compile(r"_foot_corrected$")  # of subject 03375's folder in POP's copy


class CapeRawSource(FittedSource):
    """A subject in one set of clothes: the sequences whose names begin with it, such as ``shortlong_ATUsquat_trial2``.

    The scan is ``raw_scans/<subject>/<sequence>/<sequence>.<frame>.ply`` in millimetres where it is there, else the
    registered mesh ``v_posed``, whose faces are the model's. The body is the subject's minimal shape.
    """

    layout = "cape_raw"
    home = "https://cape.is.tue.mpg.de, after registration"
    expected = (
        "  sequences/<subject>/<sequence>/<sequence>.<frame>.npz   v_posed (6890, 3), pose (72), transl (3)\n"
        "  minimal_body_shape/<subject>/<subject>_minimal.npy      or .ply\n"
        "  raw_scans/<subject>/<sequence>/<sequence>.<frame>.ply   optional, millimetres\n"
        "  where a sequence is <clothes>_<motion>, such as shortlong_ATUsquat_trial2"
    )

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        subjects = [path, *subfolders(path), *(folder for name in SEQUENCES for folder in subfolders(path / name))]
        sequences = [(subject, folder) for subject in subjects for folder in subfolders(subject) if _holds_cape(folder)]
        return dict(sorted({_outfit_of(*pair): pair[0] for pair in sequences}.items()))

    @property
    def _root(self) -> Path:
        """The folder of the release."""
        return self.path.parent.parent if self.path.parent.name in SEQUENCES else self.path.parent

    @property
    def _subject(self) -> str:
        return MISTAKEN.sub("", self.path.resolve().name)

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        found = []
        for folder in subfolders(self.path):
            if _outfit_of(self.path, folder) != self.name:
                continue
            for path in sorted(folder.glob("*.npz")):
                raw = self._root / "raw_scans" / self._subject / folder.name / f"{path.stem}.ply"
                files = (raw, path) if raw.is_file() else (path,)
                name = plain_name(path.stem, "frame")
                found.append(SourceFrame(name, "", files, folder.name, numbered(path.stem)[1]))
        return sorted_frames(self.path, found)

    @cached_property
    def rest_path(self) -> Path | None:
        return minimal_body(self._root, self._subject)

    def parameters(self, frame: SourceFrame) -> SmplParameters:
        return parameters_of(frame.files[-1], read_arrays(frame.files[-1], KEYS))

    def scan(self, frame: SourceFrame) -> RawSurface:
        if len(frame.files) > 1:
            return read_surface(frame.files[0])
        posed = read_arrays(frame.files[0], {"v_posed": "number V 3"})["v_posed"]
        return scan_of_arrays(frame.files[0], posed, None if self.body is None else self.body.faces.numpy())

    def unit_of(self, scan: RawSurface) -> str:
        return "mm" if scan.path.suffix == ".ply" else "m"


def _holds_cape(folder: Path) -> bool:
    """Whether a folder is a sequence of CAPE's."""
    path = next(folder.glob("*.npz"), None)
    return path is not None and {"v_posed", "pose", "transl"} <= npz_keys(path)


def _outfit_of(subject: Path, sequence: Path) -> str:
    """The name of an outfit, as POP has it: ``00096_shortlong``."""
    clothes = sequence.name.partition("_")[0]
    return plain_name(f"{MISTAKEN.sub('', subject.resolve().name)}_{clothes}", "outfit")
