"""Oriented point clouds on disk: binary PLY out, any scalar PLY (ASCII, little or big endian) in."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError, DataError, check_file, check_finite, check_shape, check_suffix
from avatar.io.npz import write_whole
from avatar.records import PointCloud

MAX_BYTES = 2 << 30
MAX_POINTS = 20_000_000
MAX_HEADER = 1 << 16
EXACT_LENGTH = 1e-5  # normals closer to unit length than this are kept bit for bit
LENGTH_TOLERANCE = 1e-2  # and closer than this are renormalised
COLUMNS = ("x", "y", "z", "nx", "ny", "nz")
COLORS = ("red", "green", "blue")
SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def write_points(path: str | Path, cloud: PointCloud) -> None:
    """Writes a cloud as binary little-endian PLY, whole or not at all: float32 ``x y z nx ny nz``, uchar colours.

    Equal clouds give equal bytes. Raises `AvatarError` on wrong shapes, non-finite values or colours beyond [0, 1],
    `DataError` for no points or another ending.
    """
    path = Path(path)
    check_suffix(path, (".ply",), "a file name")
    dims = check_shape("points", cloud.points, "N 3")
    check_shape("normals", cloud.normals, "N 3", **dims)
    values = np.concatenate([cloud.points, cloud.normals], axis=1).astype("<f4")
    check_finite("points, normals", values)
    if not len(values):
        raise DataError(path, "expected at least one point to write, got an empty cloud.")
    columns, rows = [f"property float {name}" for name in COLUMNS], values.view("u1")
    if cloud.colors is not None:
        check_shape("colors", cloud.colors, "N 3", **dims)
        columns += [f"property uchar {name}" for name in COLORS]
        rows = np.concatenate([rows, color_bytes(cloud.colors)], axis=1)
    lines = ["ply", "format binary_little_endian 1.0", "comment metres, y up", f"element vertex {len(values)}"]
    lines += [*columns, "end_header", ""]
    write_whole(path, "\n".join(lines).encode("ascii") + rows.tobytes())


def color_bytes(colors: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] as 8 bits a channel; raises `AvatarError` for values that are not in [0, 1]."""
    colors = np.asarray(colors, np.float64)
    if not ((colors >= 0) & (colors <= 1)).all():
        raise AvatarError(f"colors: expected RGB in [0, 1], got {colors.min():.4g} to {colors.max():.4g}.")
    return np.rint(colors * 255).astype(np.uint8)


def unit_colors(path: Path, colors: np.ndarray, whole: bool) -> np.ndarray:
    """A file's colours as float32 in [0, 1], of whole numbers to 255 or of floats; `DataError` beyond them."""
    highest = 255 if whole else 1
    if colors.size and not 0 <= colors.min() <= colors.max() <= highest:
        problem = f"expected colours from 0 to {highest}, got {colors.min():.4g} to {colors.max():.4g}."
        raise DataError(path, problem, "Store them as uint8.")
    return (colors / highest).astype(np.float32)


def read_points(path: str | Path) -> PointCloud:
    """Reads a PLY of any scalar kind: float32 points, unit normals and, where it has them, colours in [0, 1].

    Further properties and elements are ignored, normals a little off unit length renormalised. Raises `DataError`
    naming the file and what is wrong: damaged, empty, too large, no normals, non-finite values, colours beyond their
    range.
    """
    path = Path(path)
    check_suffix(path, (".ply",), "a file name")
    check_file(path, MAX_BYTES)
    data = path.read_bytes()
    row, count, rest, binary = _read_header(path, data)
    missing = [name for name in COLUMNS if name not in row.names]
    if missing:
        problem = f"expected the vertex properties {' '.join(COLUMNS)}, {' '.join(missing)} missing."
        hint = "Estimate oriented normals first (MeshLab: Compute normals for point sets)."
        raise DataError(path, problem, hint)
    if not count:
        raise DataError(path, "expected at least one point, got an empty cloud.")
    colored = set(COLORS) <= set(row.names)
    read = _read_binary if binary else _read_ascii
    values = read(path, rest, row, count, COLUMNS + COLORS if colored else COLUMNS)
    if not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).any(axis=1).sum())
        raise DataError(path, f"{bad} of {len(values)} points are NaN or infinite.", "Remove them and try again.")
    points, normals, colors = values[:, :3], values[:, 3:6], values[:, 6:]
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    off = np.abs(lengths - 1)
    if off.max() > LENGTH_TOLERANCE:
        worst = float(lengths[off.argmax(), 0])
        raise DataError(path, f"expected unit normals, got one of length {worst:.4g}.", "Normalise them first.")
    normals = np.where(off > EXACT_LENGTH, normals / lengths, normals)
    found = unit_colors(path, colors, row["red"].kind in "iu") if colored else None
    return PointCloud(points.astype(np.float32), normals.astype(np.float32), found)


def _read_header(path: Path, data: bytes) -> tuple[np.dtype, int, memoryview, bool]:
    """What a PLY header promises: a vertex's properties, their number, the bytes after it, and whether they are binary.

    The number is checked against the size of the file before anything is allocated.
    """
    end = re.search(rb"end_header[ \t]*\r?\n", data[:MAX_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise DataError(path, "expected a PLY file with a header, got something else.")
    byte_order, count, properties, element = None, None, [], ""
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", kind, *_] if kind in BYTE_ORDERS:
                byte_order = BYTE_ORDERS[kind]
            case ["element", "vertex", number] if number.isdecimal() and element == "":
                element, count = "vertex", int(number)
            case ["element", name, *_]:
                if element == "":
                    raise DataError(path, f"expected the vertices first, got element {name!r}.")
                element = name
            case ["property", kind, name] if element == "vertex" and kind in SCALARS:
                properties.append((name, SCALARS[kind]))
            case ["property", *_] if element == "vertex":
                raise DataError(path, f"the header line {line.strip()!r} is not a scalar vertex property.")
    if byte_order is None or count is None:
        raise DataError(path, "the header lacks a known format or a vertex element.")
    if len(dict(properties)) != len(properties):
        raise DataError(path, "the header names a vertex property twice.")
    if count > min(MAX_POINTS, len(data)):
        raise DataError(path, f"the header promises {count} vertices, more than the file or the limit can hold.")
    row = np.dtype([(name, byte_order + code) for name, code in properties])
    return row, count, memoryview(data)[end.end() :], bool(byte_order)


def _read_binary(path: Path, data: memoryview, row: np.dtype, count: int, columns: tuple[str, ...]) -> np.ndarray:
    if count * row.itemsize > len(data):
        held = len(data) // row.itemsize
        raise DataError(path, f"cut short: the header promises {count} vertices, the file holds {held}.")
    rows = np.frombuffer(data, row, count)
    return np.stack([rows[name].astype(np.float64) for name in columns], axis=1)


def _read_ascii(path: Path, data: memoryview, row: np.dtype, count: int, columns: tuple[str, ...]) -> np.ndarray:
    lines = [line for line in str(data, "latin-1").splitlines() if line.strip()][:count]
    if len(lines) < count:
        raise DataError(path, f"cut short: the header promises {count} vertices, got {len(lines)} lines.")
    try:
        return np.loadtxt(lines, usecols=[row.names.index(name) for name in columns], ndmin=2, comments=None)
    except ValueError as error:
        raise DataError(path, f"a vertex line cannot be read ({error}).") from error
