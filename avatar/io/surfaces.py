"""Scans and bodies as other programs write them: `read_surface` for PLY, OBJ, GLB, glTF, STL, OFF and PCD."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatar.checks import (
    AvatarError,
    DataError,
    check_faces,
    check_file,
    check_finite,
    check_shape,
    check_suffix,
    require,
)
from avatar.io.gltf import read_gltf
from avatar.io.npz import naming
from avatar.io.obj import read_obj
from avatar.io.pcd import read_pcd
from avatar.io.ply import read_ply
from avatar.io.raw_surface import RawSurface, unit_normals
from avatar.records import Mesh

MAX_BYTES = 2 << 30
MAX_VERTICES = 20_000_000


def read_surface(path: str | Path) -> RawSurface:
    """Reads a mesh or points of any program, with vertices in the file's order, unit and axes; nothing is guessed.

    Polygons become triangles (fans), STL vertices are joined at equal positions, parts of a GLB or glTF become one;
    normals are normalised. `RawSurface.notes` says what was changed or left out, `RawSurface.height` how tall it is.
    Nothing is executed, and nothing opened but buffers of a glTF within its folder. Memory is bounded by the file's
    size. Raises `DataError` naming the file and what is wrong: damaged, no vertices, no triangles with area, indices
    out of range, NaN or infinite coordinates, compressed geometry.
    """
    path = Path(path)
    suffix = check_suffix(path, READERS, "a mesh or point file")
    check_file(path, MAX_BYTES)
    with np.errstate(all="ignore"):  # what overflows is reported as not finite
        surface = READERS[suffix](path, path.read_bytes())
    return check_surface(surface)


def check_surface(surface: RawSurface) -> RawSurface:
    """The surface with float32 vertices and unit normals. Raises `DataError` for an invalid one as `read_surface`."""
    path = surface.path
    with np.errstate(all="ignore"):
        surface = replace(surface, vertices=np.asarray(surface.vertices).astype(np.float32))
    if not len(surface.vertices):
        raise DataError(path, "expected triangles or points, got no vertices.", "Hint: export the mesh itself.")
    what = "points" if surface.faces is None else "mesh"
    with naming(path, prefix=f"holds no valid {what}: "):
        if surface.faces is not None:
            check_mesh(surface.mesh)
        else:
            check_finite("points", surface.vertices)
            if len(surface.vertices) > MAX_VERTICES:
                raise AvatarError(f"points: expected at most {MAX_VERTICES}, got {len(surface.vertices)}.")
    if surface.normals is not None:
        normals, notes = unit_normals(surface.normals, surface.vertices, surface.faces)
        surface = replace(surface, normals=normals).noted(*notes)
    return surface


def check_mesh(mesh: Mesh) -> None:
    """Refuses a mesh that is empty, not finite, refers to vertices it lacks or has no triangle with area."""
    dims = check_shape("vertices", mesh.vertices, "V 3")
    if dims["V"] > MAX_VERTICES:
        raise AvatarError(f"vertices: expected at most {MAX_VERTICES}, got {dims['V']}.")
    check_finite("vertices", mesh.vertices)
    check_faces(mesh.faces, dims["V"])
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    if not (np.cross(b - a, c - a) != 0).any():
        raise AvatarError("faces: expected triangles with area, got none.")
    if mesh.colors is not None:
        check_shape("colors", mesh.colors, "V 3", **dims)
        check_finite("colors", mesh.colors)


def _read_plain(path: Path, data: bytes) -> RawSurface:
    """An STL or OFF mesh, by trimesh; numbers that the headers promise are checked first."""
    suffix = path.suffix.lower()
    text = data[:4096]
    counts = re.findall(rb"\d+", re.sub(rb"#[^\n]*", b"", text))[:3] if suffix == ".off" else []
    if max(map(int, counts), default=0) > len(data):
        largest = max(map(int, counts))
        raise DataError(
            path, f"expected a whole file, it promises {largest} elements, more than its {len(data)} bytes."
        )
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):  # the check is stricter
            solid = require("trimesh").load_mesh(io.BytesIO(data), file_type=suffix[1:], process=False)
        vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces, np.int64)
        if faces.size == 0:
            faces = faces.reshape(0, 3)
    except Exception as error:  # a parser fed with foreign bytes may raise anything
        raise DataError(path, f"cannot be read as {suffix[1:].upper()} ({error!r:.200}).") from error
    if suffix == ".stl" and len(vertices):
        vertices, joined = np.unique(vertices, axis=0, return_inverse=True)
        faces = joined.reshape(-1)[faces]
    return RawSurface(path, vertices, faces)


READERS = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".stl": _read_plain,
    ".off": _read_plain,
    ".pcd": read_pcd,
}
