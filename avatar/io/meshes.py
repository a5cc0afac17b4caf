"""Triangle meshes on disk: PLY, OBJ, GLB, STL and OFF through trimesh, with a check of our own after it."""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
from contextlib import suppress
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
from avatar.io.npz import naming, write_whole
from avatar.records import Mesh

FORMATS = (".ply", ".obj", ".glb", ".stl", ".off")
COLORED = (".ply", ".glb")
MAX_BYTES = 2 << 30
MAX_VERTICES = 20_000_000


def write_mesh(path: str | Path, mesh: Mesh) -> None:
    """Writes a mesh in the format its file name ends in: PLY, OBJ, GLB, STL or OFF; metres, y up.

    Vertices are float32. PLY and GLB keep the colours (8 bits a channel); STL keeps only the triangles. Equal meshes
    give equal bytes, and the file appears whole or not at all. Raises `AvatarError` for a mesh that is not valid,
    `DataError` for another file name ending.
    """
    path = Path(path)
    suffix = check_suffix(path, FORMATS, "a mesh file")
    with np.errstate(over="ignore"):
        mesh = replace(mesh, vertices=np.asarray(mesh.vertices, np.float32))
    check_mesh(mesh)
    colors = None
    if mesh.colors is not None and suffix in COLORED:
        colors = np.rint(np.clip(mesh.colors, 0, 1) * 255).astype(np.uint8)
    solid = require("trimesh").Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    data = solid.export(file_type=suffix[1:])
    write_whole(path, data.encode("ascii") if isinstance(data, str) else data)


def read_mesh(path: str | Path) -> Mesh:
    """Reads a mesh: ``vertices (V, 3)`` float32, ``faces (F, 3)`` int64, and colours where PLY or GLB have them.

    Vertices keep their order. The triangle soup of an STL file is joined at equal positions; the parts of a GLB
    scene become one mesh. Files a format refers to (materials, textures) are never opened. Raises `DataError` naming
    the file and what is wrong with it: missing, another format, damaged, too large, no triangles, NaN, indices out of
    range or only triangles without area.
    """
    path = Path(path)
    suffix = check_suffix(path, FORMATS, "a mesh file")
    check_file(path, MAX_BYTES)
    data = path.read_bytes()
    largest = _largest_count(suffix, data)
    if largest > min(len(data), 3 * MAX_VERTICES):
        raise DataError(path, f"promises {largest} elements, more than its {len(data)} bytes or the limit hold.")
    trimesh = require("trimesh")
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):  # the check below is stricter
            solid = trimesh.load_mesh(
                io.BytesIO(data), file_type=suffix[1:], process=False, maintain_order=True, skip_materials=True
            )
        vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
        colored = suffix in COLORED and solid.visual.kind == "vertex"
        colors = np.asarray(solid.visual.vertex_colors)[:, :3] / np.float32(255) if colored else None
    except Exception as error:  # a parser fed with foreign bytes may raise anything
        raise DataError(path, f"cannot be read as {suffix[1:].upper()} ({error!r:.200}).") from error
    if suffix == ".stl" and len(vertices):
        vertices, joined = np.unique(vertices, axis=0, return_inverse=True)
        faces = joined.reshape(-1)[faces]
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows float32 is reported as not finite
        mesh = Mesh(vertices.astype(np.float32), faces.astype(np.int64), colors)
    with naming(path, prefix="holds no valid mesh: "):
        check_mesh(mesh)
    return mesh


def check_mesh(mesh: Mesh) -> None:
    """Refuses a mesh that is empty, not finite, refers to vertices it lacks or has no triangle with area.

    Raises `AvatarError` naming the field and what is wrong.
    """
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


def _largest_count(suffix: str, data: bytes) -> int:
    """The largest element count a PLY, OFF or GLB header promises; every element takes at least a byte."""
    counts = []
    if suffix == ".ply":
        header = data[: data.find(b"end_header") + 1]
        counts = re.findall(rb"^\s*element\s+\S+\s+(\d+)", header, re.MULTILINE)
    elif suffix == ".off":
        counts = re.findall(rb"\d+", re.sub(rb"#[^\n]*", b"", data[:4096]))[:3]
    elif suffix == ".glb" and len(data) >= 20:
        with suppress(ValueError, KeyError, TypeError):  # not valid, which the parser reports
            length = struct.unpack_from("<I", data, 12)[0]
            counts = [int(accessor["count"]) for accessor in json.loads(data[20 : 20 + length])["accessors"]]
    return max((int(count) for count in counts), default=0)
