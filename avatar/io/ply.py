"""PLY files of any program: ASCII, binary of both byte orders, elements in any order, lists of any length."""

from __future__ import annotations

import re
import warnings
from array import array
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from avatar.checks import DataError
from avatar.io.points import BYTE_ORDERS, MAX_HEADER, SCALARS
from avatar.io.raw_surface import RawSurface, fan_triangles, scale_colors, strip_triangles

POSITIONS = (("x", "y", "z"),)
NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
INDICES = ("vertex_indices", "vertex_index", "vertex_indexes")


@dataclass
class Element:
    """An element of a header: its number of rows, and its properties: name, type of values, type of a list's length."""

    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)

    @property
    def least(self) -> int:
        """Bytes that one row takes at least in a binary file."""
        return sum(np.dtype(length or kind).itemsize for _, kind, length in self.properties)


@dataclass(frozen=True)
class Lists:
    """Values of a list property: ``values (N,)`` row after row, ``lengths (rows,)``."""

    values: np.ndarray
    lengths: np.ndarray


Rows = dict[str, np.ndarray | Lists]


def read_ply(path: Path, data: bytes) -> RawSurface:
    """The mesh or the points of a PLY file, unchecked: faces of any size as fans, ``tristrips`` as triangles.

    Raises `DataError` naming the file and what is wrong: damaged, cut short, more elements declared than bytes.
    """
    order, elements, body = _header(path, data)
    rows = _read_ascii(path, body, elements) if order == "" else _read_binary(path, body, elements, order)
    vertex, notes = rows.get("vertex"), []
    positions = _columns(vertex, POSITIONS) if vertex is not None else None
    if positions is None:
        hint = "Hint: export vertices as x, y and z."
        raise DataError(path, "expected an element vertex with x, y and z, got none.", hint)
    normals, colors = _columns(vertex, NORMALS), _columns(vertex, COLORS)
    if colors is not None:
        colors, note = scale_colors(path, colors)
        notes.append(note)
    faced = rows.get("face", {})
    faces, polygons, strips = None, _lists(faced), _lists(rows.get("tristrips", {}))
    if polygons is not None:
        faces = fan_triangles(_whole(path, polygons.values), polygons.lengths)
        few = int((polygons.lengths < 3).sum())
        notes.append(f"{few} faces of fewer than 3 corners are left out." if few else "")
    elif any(len(column) if isinstance(column, np.ndarray) else len(column.lengths) for column in faced.values()):
        raise DataError(
            path, f"expected faces with vertex_indices, got {', '.join(faced)[:200]}.", "Hint: export it again."
        )
    elif strips is not None:
        corners = _whole(path, strips.values)
        stops = np.flatnonzero(corners < 0)  # -1 ends a strip
        cuts = np.unique(np.concatenate([np.cumsum(strips.lengths), stops, stops + 1]))
        faces = np.concatenate([np.empty((0, 3), np.int64), *map(strip_triangles, np.split(corners, cuts))])
    if colors is None and re.search(rb"(?im)^comment texturefile", data[:MAX_HEADER]):
        notes.append("Its texture is not read: no colours.")
    return RawSurface(path, positions, faces, normals, colors).noted(*notes)


def _header(path: Path, data: bytes) -> tuple[str, list[Element], memoryview]:
    """Byte order (empty for ASCII), elements and the bytes after the header; numbers are checked against the size."""
    end = re.search(rb"end_header[ \t]*(\r\n|\n|\r)", data[:MAX_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise DataError(path, "expected a PLY file with a header, cannot be read as PLY.", "Hint: export it again.")
    order, elements = None, []
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", kind, *_] if kind in BYTE_ORDERS:
                order = BYTE_ORDERS[kind]
            case ["element", name, number] if re.fullmatch("[0-9]{1,18}", number):
                elements.append(Element(name, int(number)))
            case ["property", "list", length, kind, name] if elements and SCALARS.get(length, "f")[0] in "iu":
                if kind not in SCALARS:
                    raise DataError(path, f"expected a known type, got the header line {line.strip()!r:.100}.")
                elements[-1].properties.append((name, SCALARS[kind], SCALARS[length]))
            case ["property", kind, name] if elements and kind in SCALARS:
                elements[-1].properties.append((name, SCALARS[kind], ""))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise DataError(path, f"expected a PLY header, got the line {line.strip()!r:.100}.")
    if order is None:
        raise DataError(path, "expected a known format in the header, got none: cannot be read as PLY.")
    body = memoryview(data)[end.end() :]
    for element in elements:
        names = [name for name, _, _ in element.properties]
        if len(set(names)) != len(names):
            raise DataError(path, f"expected every property of {element.name} once, got one twice.")
        least = max(1, element.least if order else 2 * len(names) - 1)
        if element.count * least > len(body) + 1:
            problem = f"expected a whole file, its header promises {element.count} rows of {element.name}"
            raise DataError(path, f"{problem}, more than its {len(data)} bytes hold: cut short or damaged.")
    if len({element.name for element in elements}) != len(elements):
        raise DataError(path, "expected every element once, got one twice.")
    return order, elements, body


def parse_numbers(text: bytes | memoryview) -> np.ndarray:
    """Numbers ``(N,)`` float64 of a text separated by white space, up to the first word that is none."""
    text = bytes(text)
    try:
        with warnings.catch_warnings(action="error"):  # which older versions of numpy give instead of the error
            return np.fromstring(text, np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        numbers = array("d")
        with suppress(ValueError):
            for word in text.split():
                numbers.append(float(word))
        return np.array(numbers)


def _read_ascii(path: Path, body: memoryview, elements: list[Element]) -> dict[str, Rows]:
    """Rows of each element of an ASCII file by name; line breaks do not count."""
    numbers, place, rows = parse_numbers(body), 0, {}
    for element in elements:
        rows[element.name], place = _ascii_rows(path, numbers, place, element)
    return rows


def _ascii_rows(path: Path, numbers: np.ndarray, place: int, element: Element) -> tuple[Rows, int]:
    """Rows of one element, and where the next begins."""
    properties, count = element.properties, element.count
    if not any(length for _, _, length in properties):
        width = len(properties)
        table = _piece(path, numbers, place, count * width, element).reshape(count, width)
        columns = {name: _typed(path, table[:, i], kind) for i, (name, kind, _) in enumerate(properties)}
        return columns, place + count * width
    starts = {name: np.empty(count, np.int64) for name, _, _ in properties}
    lengths = {name: np.ones(count, np.int64) for name, _, _ in properties}
    listed = [bool(length) for _, _, length in properties]
    names, values, total = [name for name, _, _ in properties], numbers, len(numbers)
    if len(properties) == 1 and count and place < total and (width := values[place]) >= 0 and width < total:
        width = int(width)  # all lists as long as the first: the usual case
        table = values[place : place + count * (width + 1)]
        if len(table) == count * (width + 1) and (table[:: width + 1] == width).all():
            lists = Lists(table.reshape(count, width + 1)[:, 1:].reshape(-1), np.full(count, width))
            return {names[0]: lists}, place + len(table)
    for row in range(count):
        for name, is_list in zip(names, listed):
            if place >= total:
                raise _short(path, element)
            if is_list:
                length = values[place]
                if not (0 <= length <= total and length == int(length)):
                    raise DataError(path, f"expected the length of a list, got {length} in {element.name} {row}.")
                lengths[name][row], place = length, place + 1
            starts[name][row] = place
            place += int(lengths[name][row])
    if place > total:
        raise _short(path, element)
    return {
        name: Lists(_gather(values, starts[name], lengths[name], 1), lengths[name])
        if length
        else _typed(path, values[starts[name]], kind)
        for name, kind, length in properties
    }, place


def _piece(path: Path, numbers: np.ndarray, place: int, size: int, element: Element) -> np.ndarray:
    """So many of the numbers from a place on; `DataError` where there are fewer."""
    if len(numbers) - place < size:
        raise _short(path, element)
    return numbers[place : place + size]


def _short(path: Path, element: Element) -> DataError:
    problem = f"expected {element.count} rows of {element.name}, got fewer: cut short, or a value is no number."
    return DataError(path, problem, "Hint: export or download it again.")


def _gather(values: np.ndarray, starts: np.ndarray, lengths: np.ndarray, width: int) -> np.ndarray:
    """Runs of ``values``, each ``width * length`` long from its start, one after the other."""
    sizes = lengths * width
    places = np.arange(sizes.sum()) + np.repeat(starts - (np.cumsum(sizes) - sizes), sizes)
    return values[places]


def _read_binary(path: Path, body: memoryview, elements: list[Element], order: str) -> dict[str, Rows]:
    """Rows of each element of a binary file by name."""
    place, rows = 0, {}
    for element in elements:
        rows[element.name], place = _binary_rows(path, body, place, element, order)
    return rows


def _binary_rows(path: Path, body: memoryview, place: int, element: Element, order: str) -> tuple[Rows, int]:
    """Rows of one element, and where the next begins: at once where all lists are as long as the first ones."""
    count, lengths, at = element.count, {}, place
    if not count or not element.properties:
        return {}, place
    fields: list[tuple] = []
    for name, kind, length in element.properties:
        if length:
            if at + np.dtype(length).itemsize > len(body):
                raise _short(path, element)
            lengths[name] = int(np.frombuffer(body, order + length, 1, at)[0])
            if not 0 <= lengths[name] <= len(body):
                raise _short(path, element)
            fields.append((f"length of {name}", order + length))
        fields.append((name, order + kind, (lengths[name],)) if length else (name, order + kind))
        at += sum(np.dtype(of[1]).itemsize * (of[2][0] if len(of) > 2 else 1) for of in fields[-1 - bool(length) :])
    size = (at - place) * count
    if place + size <= len(body):
        table = np.frombuffer(body, np.dtype(fields), count, place)
        if all((table[f"length of {name}"] == length).all() for name, length in lengths.items()):
            return {
                name: Lists(table[name].reshape(-1), np.full(count, lengths[name])) if n else table[name]
                for name, _, n in element.properties
            }, place + size
    elif not lengths:
        raise _short(path, element)
    return _uneven_rows(path, body, place, element, order)


def _uneven_rows(path: Path, body: memoryview, place: int, element: Element, order: str) -> tuple[Rows, int]:
    """Rows of an element whose lists differ in length, and where the next begins."""
    count, limit = element.count, len(body)
    byte_order = "big" if order == ">" else "little"
    starts = {name: np.empty(count, np.int64) for name, _, _ in element.properties}
    lengths = {name: np.ones(count, np.int64) for name, _, _ in element.properties}
    plan = [
        (name, np.dtype(kind).itemsize, np.dtype(n).itemsize if n else 0, n.startswith("i"))
        for name, kind, n in element.properties
    ]
    for row in range(count):
        for name, size, wide, signed in plan:
            length = 1
            if wide:
                length = int.from_bytes(body[place : place + wide], byte_order, signed=signed)
                place += wide
                lengths[name][row] = length
            starts[name][row] = place
            place += size * length
            if length < 0 or place > limit:
                raise _short(path, element)
    values = np.frombuffer(body, np.uint8)
    found: Rows = {}
    for name, kind, n in element.properties:
        column = _gather(values, starts[name], lengths[name], np.dtype(kind).itemsize).view(order + kind)
        found[name] = Lists(column, lengths[name]) if n else column
    return found, place


def _lists(rows: Rows) -> Lists | None:
    """Lists of vertex indices of an element; None where it has none, or no rows."""
    found = [rows[key] for key in INDICES if isinstance(rows.get(key), Lists)]
    return found[0] if found and len(found[0].lengths) else None


def _typed(path: Path, column: np.ndarray, kind: str) -> np.ndarray:
    """A column of numbers as its declared type; floats stay float64. `DataError` for values it cannot hold."""
    if kind[0] == "f":
        return column
    info = np.iinfo(kind)
    if not ((column >= info.min) & (column <= info.max)).all():
        raise DataError(path, f"expected numbers of type {np.dtype(kind)}, got others.", "Hint: export it again.")
    return column.astype(kind)


def _columns(rows: Rows, choices: tuple[tuple[str, ...], ...]) -> np.ndarray | None:
    """Columns ``(rows, 3)`` of the first choice of names that are all there; None where none is."""
    for names in choices:
        if all(isinstance(rows.get(name), np.ndarray) for name in names):
            return np.stack([rows[name] for name in names], axis=1)
    return None


def _whole(path: Path, values: np.ndarray) -> np.ndarray:
    """Values as int64; `DataError` where one is none."""
    whole = values.dtype.kind != "f" or ((values == np.floor(values)) & (np.abs(values) < 2**53)).all()
    if not whole:
        raise DataError(path, "expected vertex indices, got numbers that are not whole.")
    return values.astype(np.int64)
