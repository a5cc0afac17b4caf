"""Triangle meshes on disk (PLY, OBJ, GLB, STL, OFF): written through trimesh, read and checked; UV atlases of OBJ."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from avatar.checks import DataError, check_file, check_suffix, require
from avatar.io.npz import write_whole
from avatar.io.surfaces import check_mesh, read_surface
from avatar.records import Mesh

log = logging.getLogger(__name__)

FORMATS = (".ply", ".obj", ".glb", ".stl", ".off")
COLORED = (".ply", ".glb")
ATLAS_BYTES = 256 << 20
ROUNDING = 1e-5  # how far out of [0, 1] a texture coordinate may be written and still mean the border


def write_mesh(path: str | Path, mesh: Mesh) -> None:
    """Writes a mesh as PLY, OBJ, GLB, STL or OFF by its ending, whole or not at all; float32 metres, y up.

    PLY and GLB keep colours. Equal meshes give equal bytes. Raises `AvatarError` for an invalid mesh, `DataError` for
    another ending.
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
    """Reads a mesh: ``vertices (V, 3)`` float32 in order, ``faces (F, 3)`` int64, colours where the file has them.

    As `avatar.io.surfaces.read_surface`, whose notes are logged; STL vertices are joined at equal positions, the parts
    of a GLB become one. Raises `DataError` naming the file and what is wrong with it, points without faces among that.
    """
    path = Path(path)
    check_suffix(path, FORMATS, "a mesh file")
    surface = read_surface(path)
    for note in surface.notes:
        log.warning("%s: %s", path, note)
    return surface.mesh


@dataclass(frozen=True)
class MeshAtlas:
    """A mesh's UV coordinates: ``uv (U, 2)`` float32 in [0, 1], ``uv_faces (F, 3)`` int64 index of each corner's."""

    uv: np.ndarray
    uv_faces: np.ndarray


def read_obj_atlas(path: str | Path, faces: np.ndarray, vertices: int) -> MeshAtlas | None:
    """The UV atlas that an OBJ file has for a mesh of the same vertices, in any pose; None without coordinates.

    A triangle of ``faces (F, 3)`` takes the coordinates of the polygon that has its three vertices. Raises `DataError`
    naming the file and what is wrong: another mesh, polygons without coordinates, coordinates out of [0, 1].
    """
    path = Path(path)
    check_file(path, ATLAS_BYTES)
    count, places, polygons = 0, [], []
    try:
        lines = re.sub(r"#.*", "", path.read_text(encoding="utf-8"))
        for line in re.sub(r"\\[ \t]*\n", " ", lines).splitlines():  # what ends in a backslash goes on
            key, *words = line.split() or [""]
            if key == "v":
                count += 1
            elif key == "vt":
                places.append([float(word) for word in words[:2]])
            elif key == "f":
                polygons.append([_corner(word, count, len(places)) for word in words])
        uv = np.array(places, np.float32).reshape(-1, 2)
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError(path, f"cannot be read as OBJ ({error}).") from error
    if count != vertices:
        hint = "Take the UV template of this body model, with all its vertices in their order."
        raise DataError(path, f"expected the body's {vertices} vertices, got {count}: it is of another mesh.", hint)
    if not len(uv):
        return None
    low, high = float(uv.min()), float(uv.max())
    if not (low >= -ROUNDING and high <= 1 + ROUNDING):  # not so for NaN either
        hint = "Pack the islands into one tile before exporting."
        raise DataError(path, f"expected texture coordinates in [0, 1], got {low:.3g} to {high:.3g}.", hint)
    return MeshAtlas(np.clip(uv, 0, 1), _match(path, polygons, faces))


def _corner(word: str, vertices: int, places: int) -> tuple[int, int | None]:
    """Vertex and place in the atlas of a corner such as ``12/7/3`` or ``12``; negative numbers count from the last."""
    found = []
    for digits, count in zip(word.split("/")[:2], (vertices, places)):
        number = int(digits or 0)
        index = number - 1 if number > 0 else count + number
        if number and not 0 <= index < count:
            raise ValueError(f"corner {word} points to number {number} of {count}")
        found.append(index if number else None)
    if found[0] is None:
        raise ValueError(f"corner {word} has no vertex")
    return found[0], found[1] if len(found) > 1 else None


def _match(path: Path, polygons: list[list[tuple[int, int | None]]], faces: np.ndarray) -> np.ndarray:
    """The place in the atlas of each corner ``(F, 3)`` of a mesh's triangles."""
    known = {}
    for polygon in polygons:
        if len(polygon) > 4:
            raise DataError(path, f"expected triangles and quads, got a polygon of {len(polygon)} corners.")
        for corners in combinations(polygon, 3):
            known[frozenset(vertex for vertex, _ in corners)] = dict(corners)
    nothing = dict.fromkeys(np.unique(faces).tolist())
    found = [[known.get(frozenset(face), nothing)[vertex] for vertex in face] for face in faces.tolist()]
    bare = [number for number, places in enumerate(found) if None in places]
    if bare:
        hint = "Unwrap the whole body, and export the triangles or quads of its model as they are."
        first = f"the first is {bare[0]} (vertices {', '.join(map(str, faces[bare[0]]))})."
        problem = f"{len(bare)} of the body's {len(faces)} triangles have no texture coordinates, {first}"
        raise DataError(path, problem, hint)
    return np.array(found, np.int64)
