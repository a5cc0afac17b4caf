"""THuman's form: a folder a scan, with its mesh and the SMPL-X parameters that were fitted to it."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from avatar.checks import DataError, plain_name
from avatar.io.raw_surface import RawSurface
from avatar.io.surfaces import read_surface
from avatar.sources.base import SourceFrame, numbered, outfits_at, sorted_frames, subfolders
from avatar.sources.fitted import FittedSource, guessed_unit, parameter_file
from avatar.sources.parameters import FORMATS, SmplParameters, read_parameters

MESHES = (".obj", ".ply", ".glb", ".stl", ".off")
STEMS = ("smplx_param", "smplx_params", "smplx", "smpl_param", "smpl_params", "smpl", "params")


class ThumanSource(FittedSource):
    """Single scans of a subject in one set of clothes.

    The mesh is ``scan.*``, or has its folder's name; parameters lie beside it. Points are ``scale (body + transl) +
    translation``, as THuman2.0 has them, and are brought to the body's size.
    """

    layout = "thuman"
    kind = "smplx"
    home = "https://github.com/HongwenZhang/THuman-CloSET, by its agreement"
    expected = (
        "  <scan>/scan.obj          or .ply, or of the folder's name\n"
        "  <scan>/smplx_param.pkl   or .npz, .json: global_orient, body_pose, transl, betas, scale, translation"
    )

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        return outfits_at(
            folder
            for folder in (path, *subfolders(path))
            if any(_mesh_of(scan) and _parameters_beside(scan) for scan in subfolders(folder))
        )

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        found = []
        for folder in subfolders(self.path):
            if mesh := _mesh_of(folder):
                files = (mesh, *filter(None, [_parameters_beside(folder)]))
                found.append(SourceFrame(plain_name(folder.name, "scan"), "", files, "", numbered(folder.name)[1]))
        return sorted_frames(self.path, found)

    def parameters(self, frame: SourceFrame) -> SmplParameters:
        if len(frame.files) < 2:
            problem = f"expected parameters beside it, such as {STEMS[0]}.pkl, there are none."
            raise DataError(frame.files[0], problem)
        return read_parameters(frame.files[1])

    def scan(self, frame: SourceFrame) -> RawSurface:
        return read_surface(frame.files[0])

    def unit_of(self, scan: RawSurface) -> str:
        return guessed_unit(scan)


def _mesh_of(folder: Path) -> Path | None:
    """The scan's mesh in a folder."""
    stems = ("scan", folder.name)
    return next((path for stem in stems for end in MESHES if (path := folder / f"{stem}{end}").is_file()), None)


def _parameters_beside(folder: Path) -> Path | None:
    """The file of body parameters in a folder."""
    return next((path for stem in STEMS if (path := parameter_file(folder, stem, FORMATS))), None)
