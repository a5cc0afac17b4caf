"""PCD point clouds (Point Cloud Library): ASCII, binary, and small compressed ones."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from avatar.checks import DataError
from avatar.io.ply import parse_numbers
from avatar.io.points import MAX_HEADER
from avatar.io.raw_surface import RawSurface

TYPES = {"I": "i", "U": "u", "F": "f"}
COMPRESSED_BYTES = 64 << 20  # unpacked; the loop over bytes takes seconds for so many
POSITIONS, NORMALS = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")
AT_ORIGIN = (0, 0, 0, 1, 0, 0, 0)


def read_pcd(path: Path, data: bytes) -> RawSurface:
    """The points of a PCD file, unchecked; those without a measurement (x, y, z all NaN) are left out with a note.

    Colours are ``rgb`` or ``rgba``, packed into one number. Raises `DataError` naming the file and what is wrong:
    damaged, more points declared than bytes, compressed and large.
    """
    header, row, count, body = _header(path, data)
    kind = header["DATA"][0].lower()
    if kind == "ascii":
        rows = _read_ascii(path, body, row, count)
    elif kind in ("binary", "binary_compressed"):
        rows = _read_binary(path, body, row, count) if kind == "binary" else _read_compressed(path, body, row, count)
    else:
        raise DataError(path, f"expected DATA ascii, binary or binary_compressed, got {kind!r:.50}.")
    if not set(POSITIONS) <= set(rows):
        raise DataError(path, f"expected the fields x y z, got {' '.join(map(str, rows))[:200]}.")
    points, notes = np.stack([rows[name] for name in POSITIONS], axis=1), []
    normals = np.stack([rows[name] for name in NORMALS], axis=1) if set(NORMALS) <= set(rows) else None
    packed = next((rows[name] for name in ("rgb", "rgba") if name in rows), None)
    colors = None if packed is None else _unpack_colors(packed)
    measured = ~np.isnan(points).all(axis=1)
    if not measured.all():
        notes.append(f"{(~measured).sum()} of {count} points without a measurement (NaN) are left out.")
        points = points[measured]
        normals, colors = (None if of is None else of[measured] for of in (normals, colors))
    if tuple(map(float, header.get("VIEWPOINT", AT_ORIGIN))) != AT_ORIGIN:
        notes.append("Its VIEWPOINT is not applied: points stay in the file's own frame.")
    return RawSurface(path, points, None, normals, colors).noted(*notes)


def _header(path: Path, data: bytes) -> tuple[dict[str, list[str]], np.dtype, int, memoryview]:
    """Words of a header by key, the type of a row, the number of points and the bytes after the header."""
    end = re.search(rb"(?m)^DATA[ \t]+\S+[ \t]*\r?\n", data[:MAX_HEADER])
    if end is None:
        raise DataError(path, "expected a PCD file with a header, cannot be read as PCD.", "Hint: export it again.")
    lines = [line.split() for line in data[: end.end()].decode("latin-1").splitlines()]
    header = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    try:
        names, count = header["FIELDS"], int(header.get("POINTS", [""])[0] or 0)
        counts = [int(word) for word in header.get("COUNT", ["1"] * len(names))]
        kinds = [TYPES[kind] + str(int(size)) for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        if "POINTS" not in header:
            count = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        viewpoint = [float(word) for word in header.get("VIEWPOINT", AT_ORIGIN)]
        if min(counts) < 1 or max(counts) > len(data) or count < 0 or len(viewpoint) != 7:
            raise ValueError("numbers out of range")
        # several padding fields share the name "_": a field is known by its place
        unique = [name if names.index(name) == i else f"{name} {i}" for i, name in enumerate(names)]
        row = np.dtype([(name, f"<{kind}", (size,)) for name, kind, size in zip(unique, kinds, counts, strict=True)])
    except (KeyError, IndexError, ValueError, TypeError, OverflowError) as error:
        raise DataError(path, f"expected a PCD header, cannot be read as PCD ({error!r:.200}).") from error
    least = {"binary": row.itemsize, "ascii": 2 * sum(counts) - 1}.get(header["DATA"][0].lower(), 0)
    if count * least > len(data) or (not least and count * row.itemsize > 100 * len(data)):
        problem = f"expected a whole file, its header promises {count} points, more than its {len(data)} bytes hold."
        raise DataError(path, problem, "Hint: export or download it again.")
    return header, row, count, memoryview(data)[end.end() :]


def _read_ascii(path: Path, body: memoryview, row: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Fields of single numbers by name."""
    width = sum(row[name].shape[0] for name in row.names)
    numbers = parse_numbers(body)[: count * width]
    if len(numbers) < count * width:
        problem = f"expected {count} points, got {len(numbers) // width}: cut short, or a value is no number."
        raise DataError(path, problem)
    table, place, found = numbers.reshape(count, width), 0, {}
    for name in row.names:
        column, size = table[:, place], row[name].shape[0]
        if size == 1:
            base = row[name].base
            if base.kind in "iu" and not ((column >= np.iinfo(base).min) & (column <= np.iinfo(base).max)).all():
                raise DataError(path, f"{name}: expected numbers of type {base}, got others.")
            with np.errstate(over="ignore"):
                found[name] = column.astype(base)
        place += size
    return found


def _read_binary(path: Path, body: memoryview, row: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Fields of single numbers by name."""
    if count * row.itemsize > len(body):
        raise DataError(path, f"expected {count} points, got {len(body) // row.itemsize}: cut short.")
    table = np.frombuffer(body, row, count)
    return {name: table[name][:, 0] for name in row.names if row[name].shape == (1,)}


def _read_compressed(path: Path, body: memoryview, row: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Fields of single numbers by name, of an LZF stream that holds field after field."""
    packed, plain = struct.unpack_from("<II", body) if len(body) >= 8 else (0, -1)
    if plain != count * row.itemsize or packed > len(body) - 8:
        problem = f"expected {count} compressed points ({count * row.itemsize} bytes), got {plain} bytes or a cut end."
        raise DataError(path, problem)
    if plain > COMPRESSED_BYTES:
        problem = f"expected at most {COMPRESSED_BYTES} bytes of compressed points, got {plain}."
        hint = "Hint: pcl_convert_pcd_ascii_binary in.pcd out.pcd 1 (of the Point Cloud Library) writes plain binary."
        raise DataError(path, problem, hint)
    data, place, found = _unpack_lzf(path, bytes(body[8 : 8 + packed]), plain), 0, {}
    for name in row.names:
        base, size = row[name].base, row[name].shape[0]
        if size == 1:
            found[name] = np.frombuffer(data, base, count, place)
        place += count * size * base.itemsize
    return found


def _unpack_lzf(path: Path, packed: bytes, size: int) -> bytes:
    """Bytes of an LZF stream: runs of literals (control below 32), else copies of what was unpacked before."""
    plain, place = bytearray(), 0
    try:
        while place < len(packed) and len(plain) <= size:
            control = packed[place]
            place += 1
            if control < 32:
                if place + control + 1 > len(packed):
                    raise IndexError
                plain += packed[place : place + control + 1]
                place += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[place]
                place += 1
            start = len(plain) - ((control & 31) << 8 | packed[place]) - 1
            place += 1
            if start < 0:
                raise IndexError
            for offset in range(start, start + length + 2):  # may overlap what it appends
                plain.append(plain[offset])
    except IndexError:
        raise DataError(path, "expected a whole LZF stream, got a damaged one.") from None
    if len(plain) != size:
        raise DataError(path, f"expected {size} bytes unpacked, got {len(plain)}: damaged.")
    return bytes(plain)


def _unpack_colors(packed: np.ndarray) -> np.ndarray:
    """Colours ``(N, 3)`` in [0, 1] of numbers whose bits are 0xAARRGGBB, floats and whole numbers alike."""
    bits = packed.astype(np.float32).view(np.uint32) if packed.dtype.kind == "f" else packed.astype(np.int64)
    return (np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1) / 255).astype(np.float32)
