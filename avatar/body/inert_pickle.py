"""Pickles of arrays read without trust: nothing that is in one is ever run.

A pickle is a program. Here every class and function it may name is replaced by an inert stand-in that only keeps what
it is given, and any other name is refused.
"""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from avatar.checks import AvatarError, DataError

SIZE_LIMIT = 2 << 30  # bytes of a pickle; SMPL-X with all its blendshapes has 0.5 GB
ENTRY_LIMIT = 10**8  # entries of a matrix that is stored sparse


def read_pickled_arrays(path: Path, required: Iterable[str], optional: Iterable[str] = ()) -> dict[str, np.ndarray]:
    """Named arrays of a pickled dictionary, such as an SMPL body model or a scan; other keys are never looked at.

    Knows arrays of numpy, matrices of scipy.sparse and arrays of chumpy, as Python 2 or 3 wrote them; plain text, such
    as a gender, becomes an array of text. Raises `DataError` for a missing, damaged, oversized or hostile file, missing
    ``required`` keys, or keys that hold neither.
    """
    required = tuple(required)
    if not path.is_file():
        raise DataError(path, "expected a pickle, there is none.")
    if path.stat().st_size > SIZE_LIMIT:
        raise DataError(path, f"expected at most {SIZE_LIMIT} bytes, got {path.stat().st_size}.")
    try:
        # from memory: a length that the file invents is then cut at its end, and never allocated
        stored = InertUnpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()
    except Exception as error:  # a damaged or hostile pickle can raise anything
        raise DataError(path, f"expected a valid pickle of arrays, reading failed: {error}.") from error
    if not isinstance(stored, dict):
        raise DataError(path, f"expected a pickled dictionary, got {type(stored).__name__}.")
    missing = [key for key in required if key not in stored]
    if missing:
        raise DataError(path, f"expected the keys {', '.join(required)}, it lacks {', '.join(missing)}.")
    arrays = {}
    for key in (key for key in (*required, *optional) if key in stored):
        try:
            arrays[key] = as_array(stored[key])
        except Exception as error:  # the state of a stand-in is whatever the file put there
            raise DataError(path, f"{key}: expected an array of numbers, reading failed: {error}.") from error
    return arrays


class Inert:
    """Stand-in for what a pickle names: keeps the arguments and the state it is given, and does nothing."""

    arguments: tuple = ()
    state: Any = None

    def __init__(self, *arguments: Any):
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


def as_array(value: Any) -> np.ndarray:
    """The numbers of a stand-in, or of a plain list, or plain text."""
    if isinstance(value, str):
        return np.array(value)
    read = KNOWN[type(value).__name__][0] if isinstance(value, Inert) else np.asarray
    if read is None:
        raise AvatarError(f"{type(value).__name__} stands for no array")
    array = read(value)
    if array.dtype.kind not in "biuf":
        raise AvatarError(f"not numbers but {array.dtype}")
    return array


def plain_dtype(dtype: Inert) -> np.dtype:
    """The number type with its byte order that a dtype's stand-in describes; no other type is known."""
    code, order = dtype.arguments[0], dtype.state[1] if dtype.state else "="
    if not re.fullmatch(r"[biuf][1248]", code) or order not in ("<", ">", "=", "|"):
        raise AvatarError(f"not numbers but {code}")
    return np.dtype(code).newbyteorder(order)


def read_array(stored: Inert) -> np.ndarray:
    """An array of numpy, its bytes read as plain numbers."""
    _, shape, dtype, fortran, raw = stored.state
    return np.frombuffer(plain_bytes(raw), plain_dtype(dtype)).reshape(shape, order="F" if fortran else "C")


def plain_bytes(raw: Any) -> bytes:
    """The bytes of an array or number."""
    raw = raw.arguments[0] if isinstance(raw, Inert) else raw  # of _codecs.encode, by which Python 3 writes old pickles
    return raw.encode("latin1") if isinstance(raw, str) else raw  # Python 2 wrote bytes as text


def read_scalar(stored: Inert) -> np.ndarray:
    """One number of numpy, as an array without dimensions."""
    dtype, raw = stored.arguments
    return np.frombuffer(plain_bytes(raw), plain_dtype(dtype)).reshape(())


def read_buffer(stored: Inert) -> np.ndarray:
    """An array of pickle protocol 5."""
    raw, dtype, shape, order = stored.arguments
    return np.frombuffer(raw, plain_dtype(dtype)).reshape(shape, order=order)


def read_sparse(stored: Inert) -> np.ndarray:
    """A matrix of scipy as a dense one."""
    rows, columns = stored.state["_shape"]
    if not 0 < rows * columns <= ENTRY_LIMIT:
        raise AvatarError(f"a sparse matrix of {rows} x {columns} is too large")
    values, inner, starts = (as_array(stored.state[key]) for key in ("data", "indices", "indptr"))
    outer = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    places = (inner, outer) if type(stored).__name__ == "csc_matrix" else (outer, inner)
    dense = np.zeros((rows, columns), values.dtype)
    np.add.at(dense, places, values)  # which checks every index; scipy's own code trusts some starts
    return dense


def read_selection(stored: Inert) -> np.ndarray:
    """chumpy's entries of another array, in another shape."""
    entries = as_array(stored.state["a"]).ravel()[as_array(stored.state["idxs"])]
    return entries.reshape(stored.state["preferred_shape"]) if "preferred_shape" in stored.state else entries


def read_object(stored: Inert) -> np.ndarray:
    """An object that Python 2 made of a class, whose stand-in gets its state."""
    twin = stored.arguments[0]()
    twin.state = stored.state
    return as_array(twin)


MULTIARRAY, NUMERIC = (("numpy.core." + part, "numpy._core." + part) for part in ("multiarray", "numeric"))
KNOWN = {  # all that a pickle may name: what reads an object of that name, and the modules it may be in
    "_reconstruct": (read_array, *MULTIARRAY),
    "_frombuffer": (read_buffer, *NUMERIC),
    "ndarray": (read_array, "numpy"),
    "csc_matrix": (read_sparse, "scipy.sparse.csc", "scipy.sparse._csc"),
    "csr_matrix": (read_sparse, "scipy.sparse.csr", "scipy.sparse._csr"),
    "Ch": (lambda stored: as_array(stored.state["x"]), "chumpy.ch"),  # chumpy's plain array
    "Select": (read_selection, "chumpy.reordering"),
    "_reconstructor": (read_object, "copy_reg", "copyreg"),
    "dtype": (None, "numpy"),
    "scalar": (read_scalar, *MULTIARRAY),
    "object": (None, "__builtin__", "builtins"),
    "encode": (None, "_codecs"),
}
STAND_INS = {name: type(name, (Inert,), {}) for name in KNOWN}


class InertUnpickler(pickle._Unpickler):
    """Unpickler that knows the stand-ins and nothing else: it imports no module and runs no code of the file.

    Python's own unpickler rather than the one in C, which a few bytes can make allocate gigabytes for its memo.
    """

    def find_class(self, module: str, name: str) -> type[Inert]:
        """The stand-in of a name; refuses any other name."""
        if module not in KNOWN.get(name, ())[1:]:
            raise pickle.UnpicklingError(f"refused {module}.{name}, which has no place in a file of arrays")
        return STAND_INS[name]
