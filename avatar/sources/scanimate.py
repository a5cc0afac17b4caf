"""SCANimate's folders: a minimal body in the T-pose, and sequences of scans with SMPL's parameters beside each."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from avatar.checks import DataError, plain_name
from avatar.io.raw_surface import RawSurface
from avatar.io.surfaces import read_surface
from avatar.sources.base import SourceFrame, numbered, outfits_at, sorted_frames, subfolders
from avatar.sources.fitted import FittedSource, guessed_unit, parameter_file
from avatar.sources.parameters import SmplParameters, read_parameters

FORMATS = (".npz", ".pkl")
TEXTURED = "textured"  # folders whose names hold it are copies of others with textures


class ScanimateSource(FittedSource):
    """A subject in one set of clothes. Scans without parameters are refused when they are read, by their names."""

    layout = "scanimate"
    home = "https://scanimate.is.tue.mpg.de, after registration, or as your own scans in SCANimate's form"
    expected = (
        "  <any name>.ply              minimal body in the T-pose, with the model's vertices (SMPL: 6890)\n"
        "  <sequence>/<frame>.ply      scan\n"
        "  <sequence>/<frame>.npz      pose (72), transl (3); or .pkl with pose, trans, betas"
    )

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        return outfits_at(folder for folder in (path, *subfolders(path)) if _holds_scans(folder))

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        found = []
        for folder in _sequences(self.path):
            for path in sorted(folder.glob("*.ply")):
                files = (path, *filter(None, [parameter_file(folder, path.stem, FORMATS)]))
                number = numbered(path.stem)[1]
                name = path.stem if path.stem.startswith(folder.name) else f"{folder.name}.{path.stem}"
                found.append(SourceFrame(plain_name(name, "frame"), "", files, folder.name, number))
        return sorted_frames(self.path, found)

    @cached_property
    def rest_path(self) -> Path | None:
        return min(self.path.glob("*.ply"))

    def parameters(self, frame: SourceFrame) -> SmplParameters:
        if len(frame.files) < 2:
            expected = " or ".join(frame.files[0].with_suffix(suffix).name for suffix in FORMATS)
            raise DataError(frame.files[0], f"expected body parameters in {expected} beside it, there are none.")
        return read_parameters(frame.files[1])

    def scan(self, frame: SourceFrame) -> RawSurface:
        return read_surface(frame.files[0])

    def unit_of(self, scan: RawSurface) -> str:
        return guessed_unit(scan)


def _sequences(path: Path) -> list[Path]:
    return [folder for folder in subfolders(path) if TEXTURED not in folder.name]


def _holds_scans(path: Path) -> bool:
    """Whether a folder has a mesh of its own and folders of scans of which one has parameters."""
    if not path.is_dir() or next(path.glob("*.ply"), None) is None:
        return False
    scans = (scan for folder in _sequences(path) for scan in folder.glob("*.ply"))
    return any(parameter_file(scan.parent, scan.stem, FORMATS) for scan in scans)
