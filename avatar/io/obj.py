"""OBJ files of any program: polygons of any size, vertex colours, vertices in the file's order and number."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from avatar.checks import DataError
from avatar.io.raw_surface import RawSurface, fan_triangles, scale_colors

BOM = b"\xef\xbb\xbf"
WIDE_BOMS = (b"\xff\xfe", b"\xfe\xff")
COLUMNS = {6: slice(4, 7), 7: slice(4, 7)}  # numbers of a vertex with colours: x y z r g b, and alpha


def read_obj(path: Path, data: bytes) -> RawSurface:
    """The mesh or the points of an OBJ file, unchecked: polygons as fans, one vertex for every ``v`` line.

    Texture coordinates and normals of corners do not split vertices; normals are kept for points alone (as many ``vn``
    as ``v``). Materials are not opened. Raises `DataError` naming the file, the line and what is wrong with it.
    """
    if data.startswith(WIDE_BOMS):
        raise DataError(path, "expected OBJ in UTF-8, got UTF-16.", "Hint: save it as UTF-8.")
    data = data.removeprefix(BOM).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    vertices, colors, normals = array("d"), array("d"), array("d")
    corners, lengths = array("q"), array("q")
    count, textures, materials, free_forms = 0, 0, False, 0
    line = b""
    try:
        for line in _lines(data):
            words = line.split()
            key = words[0] if words else b""
            if key == b"v":
                vertices.extend(map(float, words[1:4]))
                count += 1
                if len(vertices) != 3 * count:
                    raise ValueError("expected x, y and z")
                if len(words) - 1 in COLUMNS:
                    colors.extend(map(float, words[COLUMNS[len(words) - 1]]))
            elif key == b"f":
                corners.extend([_vertex(word, count) for word in words[1:]])
                lengths.append(len(words) - 1)
            elif key == b"vn":
                normals.extend(map(float, words[1:4]))
            elif key == b"vt":
                textures += 1
            elif key in (b"mtllib", b"usemtl"):
                materials = True
            elif key == b"surf":
                free_forms += 1
    except (ValueError, OverflowError) as error:
        hint = "Hint: export it again as a polygon mesh."
        raise DataError(
            path, f"the line {line.strip()!r:.100} cannot be read as OBJ ({error!s:.200}).", hint
        ) from error
    found, notes = None, []
    if len(colors) == len(vertices) and count:
        found, note = scale_colors(path, np.array(colors).reshape(-1, 3))
        notes.append(note)
    elif colors:
        notes.append(f"Colours are left out: {len(colors) // 3} of {count} vertices have them.")
    if found is None and textures and materials:
        notes.append("Materials and textures are not read: no colours.")
    few = int((np.array(lengths) < 3).sum())
    notes.append(f"{few} faces of fewer than 3 corners are left out." if few else "")
    notes.append(f"{free_forms} free-form surfaces are left out." if free_forms else "")
    faces = fan_triangles(np.array(corners, np.int64), np.array(lengths, np.int64)) if lengths else None
    oriented = faces is None and count and len(normals) == len(vertices)
    return RawSurface(
        path,
        np.array(vertices).reshape(-1, 3),
        faces,
        np.array(normals).reshape(-1, 3) if oriented else None,
        found,
    ).noted(*notes)


def _lines(data: bytes) -> Iterator[bytes]:
    """Lines without comments; those that end in a backslash go on in the next."""
    if b"\\" in data:
        data = re.sub(rb"\\[ \t]*\n", b" ", data)
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    start = 0
    while start < len(data):
        stop = data.find(b"\n", start)
        stop = len(data) if stop < 0 else stop
        yield data[start:stop]
        start = stop + 1


def _vertex(word: bytes, count: int) -> int:
    """Vertex index of a corner such as ``12/7/3`` or ``12``; negative numbers count back from the last vertex."""
    index = int(word.partition(b"/")[0])
    if index > 0:
        return index - 1
    if not -count <= index < 0:
        raise ValueError(f"corner {word.decode('latin-1')} points to vertex {index} of {count}")
    return count + index
