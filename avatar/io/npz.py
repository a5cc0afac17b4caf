"""Array files (npz): read without trust (sizes checked first, no pickles), written whole and reproducibly."""

from __future__ import annotations

import io
import math
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from avatar.checks import AvatarError, DataError, check_file, check_finite, check_shape

SIZE_LIMIT = 4 << 30  # bytes of arrays in one file, unpacked
MEMBER_LIMIT = 200
SWELLING = 100  # arrays of measured things deflate ten times at most; zeros, a thousand times
SMALL = 16 << 20  # bytes unpacked that nobody needs to look at
DTYPE_KINDS = {"float": "f", "int": "iu", "bool": "b", "text": "U", "number": "fiu", "scalar": "fiuUS"}
STORED = {"float": np.float32, "int": np.int32, "bool": bool, "text": np.str_, "number": np.float64}
READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError)  # what zipfile raises
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)  # one time stamp for all members, so that equal arrays give equal bytes


@contextmanager
def naming(path: Path, hint: str = "", prefix: str = "") -> Iterator[None]:
    """Turns an `AvatarError` about what a file holds into a `DataError` that names the file, within a block."""
    try:
        yield
    except DataError:
        raise
    except AvatarError as error:
        raise DataError(path, f"{prefix}{error}", hint) from error


def read_arrays(
    path: Path,
    required: Mapping[str, str],
    optional: Mapping[str, str] | None = None,
    limit: int = SIZE_LIMIT,
    version: str = "",
) -> dict[str, np.ndarray]:
    """Reads named arrays of an npz file; other keys are never decoded, so what they hold does not matter.

    A key is described by its kind (float, int, bool, text, number or a dtype) and its shape, as in ``"float V 3"`` or
    ``"float V 3 3 | V 4 4"``; a named size is the same wherever it stands. Sizes and headers are checked before
    anything is allocated. Raises `DataError` naming file and key: damaged, more than ``limit`` bytes unpacked, pickled,
    missing, another ``version`` in its ``format``, wrong kinds or shapes, NaN or infinite numbers.
    """
    path, optional = Path(path), optional or {}
    if not path.is_file():
        raise DataError(path, "expected an npz file, there is none.")
    try:
        with zipfile.ZipFile(path) as archive:
            members = _members(path, archive, limit)
            absent = [key for key in ([*required, "format"] if version else required) if key not in members]
            if absent:
                there = ", ".join(sorted(members)) or "none"
                raise DataError(path, f"expected the keys {', '.join(absent)}, found only: {there}.")
            dims: dict[str, int] = {}
            if version and (found := str(_read(path, archive, members["format"], "format", "text ", dims))) != version:
                hint = "Make the data again with this version, or use the version that wrote it."
                raise DataError(path, f"expected format {version}, got {found}.", hint)
            wanted = {**required, **{key: optional[key] for key in optional if key in members}}
            return {key: _read(path, archive, members[key], key, wanted[key], dims) for key in wanted}
    except DAMAGED as error:
        hint = "Make or download it again."
        raise DataError(path, f"expected a valid npz file, reading failed: {error}.", hint) from error


def npz_keys(path: Path) -> set[str]:
    """The keys of an npz file, unread; none of what is no such file."""
    return set(member_checksums(path))


def read_npy(path: Path, description: str, limit: int = SIZE_LIMIT) -> np.ndarray:
    """The array of an npy file, whose kind and shape are described and checked as those of `read_arrays`."""
    kind, _, pattern = description.partition(" ")
    check_file(path, limit)
    with path.open("rb") as stream:
        return _read_stream(path, stream, path.stat().st_size, path.name, kind, pattern, {})


def member_checksums(path: Path) -> dict[str, tuple[int, int]]:
    """CRC-32 and bytes of an npz file's arrays by key, from its directory alone; nothing of a file that has none."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()[:MEMBER_LIMIT]
            return {info.filename.removesuffix(".npy"): (info.CRC, info.file_size) for info in infos}
    except (*DAMAGED, ValueError):
        return {}


def _members(path: Path, archive: zipfile.ZipFile, limit: int) -> dict[str, zipfile.ZipInfo]:
    """Array members by key, after the checks that need no reading."""
    infos = archive.infolist()
    if len(infos) > MEMBER_LIMIT:
        raise DataError(path, f"expected at most {MEMBER_LIMIT} arrays, found {len(infos)}.")
    total, packed = (sum(getattr(info, of) for info in infos) for of in ("file_size", "compress_size"))
    if total > max(SMALL, SWELLING * packed):
        raise DataError(path, f"expected arrays, it swells from {packed} bytes to {total} on unpacking: not read.")
    if total > limit:
        raise DataError(path, f"expected at most {limit} bytes of arrays, it declares {total}.")
    members = {info.filename.removesuffix(".npy"): info for info in infos}
    if len(members) != len(infos):
        raise DataError(path, "expected every key once, found a key twice.")
    return members


def _read(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, key: str, description: str, dims: dict) -> Any:
    """One member as an array; ``dims`` holds the named sizes from key to key."""
    kind, _, pattern = description.partition(" ")
    with archive.open(info) as stream:
        return _read_stream(path, stream, info.file_size, key, kind, pattern, dims)


def _read_stream(path: Path, stream: IO[bytes], size: int, key: str, kind: str, pattern: str, dims: dict) -> np.ndarray:
    """The array that a stream of ``size`` bytes holds in numpy's format, checked."""
    try:
        shape, fortran, dtype = READERS[np.lib.format.read_magic(stream)](stream)
        _check_header(path, key, shape, dtype, kind, size - stream.tell())
        array = np.frombuffer(bytearray(stream.read()), dtype=dtype)
        array = array.reshape(shape, order="F" if fortran else "C")
    except (*DAMAGED, DataError, MemoryError):
        raise
    except Exception as error:  # numpy takes an array's header for Python and may raise what Python does
        raise DataError(path, f"{key}: expected a plain array, it is not one ({error}).") from error
    with naming(path):
        _match(key, array, pattern, dims)
    return array


def _check_header(path: Path, key: str, shape: tuple, dtype: np.dtype, kind: str, stored: int) -> None:
    """Refuses an array whose header promises other than its member holds, or another kind than is wanted."""
    if dtype.hasobject or dtype.names:
        raise DataError(path, f"{key}: expected {kind}, found Python objects or records: not read.")
    if (dtype.kind not in DTYPE_KINDS[kind]) if kind in DTYPE_KINDS else dtype != np.dtype(kind):
        raise DataError(path, f"{key}: expected {kind}, got {dtype}.")
    size = math.prod(shape, start=dtype.itemsize)
    if any(length < 0 for length in shape) or size != stored:
        raise DataError(path, f"{key}: its header declares {size} bytes of {shape}, the file holds {stored}.")


def _match(key: str, array: np.ndarray, pattern: str, dims: dict[str, int]) -> None:
    """Adds the named sizes after the first of the patterns ``A | B`` that fits; refuses other shapes, NaN, infinity."""
    *others, last = (choice.strip() for choice in pattern.split("|"))
    for choice in others:
        with suppress(AvatarError):
            dims.update(check_shape(key, array, choice, **dims))
            break
    else:
        dims.update(check_shape(key, array, last, **dims))
    if array.dtype.kind == "f":
        check_finite(key, array)


def write_described(path: Path, version: str, described: Mapping[str, str], values: Mapping[str, Any], level=9) -> None:
    """Writes what `read_arrays` reads with the same descriptions and ``version``; values that are None are left out.

    Floats are stored as float32, whole numbers as int32. Raises `AvatarError` for other shapes, NaN or infinity.
    """
    arrays, dims = {"format": np.array(version)}, {}
    for key, value in values.items():
        if value is not None:
            kind, _, pattern = described[key].partition(" ")
            arrays[key] = np.asarray(value, STORED.get(kind, kind))
            _match(key, arrays[key], pattern, dims)
    write_arrays(path, arrays, level)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], level: int = 9) -> None:
    """Writes an npz file whole or not at all; equal arrays give equal bytes, so that files can be hashed.

    ``level`` of deflating: 1 (fast) to 9 (small). Raises `AvatarError` for an array of Python objects.
    """
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in arrays.items():
            array = np.asarray(value)
            if array.dtype.hasobject:
                raise AvatarError(f"{key}: expected numbers or text to write to {path}, got Python objects.")
            plain = io.BytesIO()
            np.lib.format.write_array(plain, array, allow_pickle=False)
            info = zipfile.ZipInfo(f"{key}.npy", ZIP_EPOCH)
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, plain.getvalue(), compresslevel=level)
    write_whole(path, packed.getvalue())


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file atomically: a temporary file beside it, flushed, then renamed. Makes its folder.

    Raises `DataError`, its cause the `OSError`, when the disk refuses; the file that was there before is there still.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        hint = "Free disk space and give the same command again."
        raise DataError(path, f"could not be written ({error.strerror}; {len(data):,} bytes).", hint) from error
