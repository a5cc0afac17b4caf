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
    """Named arrays of a pickled dictionary, such as an SMPL body model; other keys are never looked at.

    Knows arrays of numpy, matrices of scipy.sparse and arrays of chumpy, as Python 2 or 3 wrote them.

    Args:
        path: the pickle.
        required: keys that must be there.
        optional: keys that are read where present.

    Raises `DataError` for a missing, damaged, oversized or hostile file, missing keys, or keys that hold no numbers.
    """
    required = tuple(required)
    if not path.is_file():
        raise DataError(path, "expected a body-model file, there is none.")
    if path.stat().st_size > SIZE_LIMIT:
        raise DataError(path, f"expected at most {SIZE_LIMIT} bytes, got {path.stat().st_size}.")
    try:
        # from memory: a length that the file invents is then cut at its end, and never allocated
        stored = InertUnpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()
    except Exception as error:  # a damaged or hostile pickle can raise anything
        raise DataError(path, f"expected a valid body-model pickle, reading failed: {error}.") from error
    if not isinstance(stored, dict):
        raise DataError(path, f"expected a pickled dictionary, got {type(stored).__name__}.")
    missing = [key for key in required if key not in stored]
    if missing:
        raise DataError(path, f"expected a body model, it lacks {', '.join(missing)}.")
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

    def array(self) -> np.ndarray:
        """The numbers this object stands for."""
        raise AvatarError(f"{type(self).__name__} stands for no array")


class PickledBytes(Inert):
    """Stand-in for _codecs.encode, in which Python 3 wraps bytes for old pickles."""


class PickledDtype(Inert):
    """Stand-in for numpy.dtype."""

    def plain(self) -> np.dtype:
        """The number type with its byte order; no other type is known."""
        code, order = self.arguments[0], self.state[1] if self.state else "="
        if not re.fullmatch(r"[biuf][1248]", code) or order not in ("<", ">", "=", "|"):
            raise AvatarError(f"not numbers but {code}")
        return np.dtype(code).newbyteorder(order)


class PickledArray(Inert):
    """Stand-in for numpy.ndarray and for the function that makes one."""

    def array(self) -> np.ndarray:
        """The array, its bytes read as plain numbers."""
        _, shape, dtype, fortran, raw = self.state
        if isinstance(raw, PickledBytes):
            raw = raw.arguments[0]
        data = raw.encode("latin1") if isinstance(raw, str) else raw  # Python 2 wrote bytes as text
        return np.frombuffer(data, dtype.plain()).reshape(shape, order="F" if fortran else "C")


class PickledBuffer(Inert):
    """Stand-in for numpy's _frombuffer, which makes arrays of pickle protocol 5."""

    def array(self) -> np.ndarray:
        """The array, its bytes read as plain numbers."""
        raw, dtype, shape, order = self.arguments
        return np.frombuffer(raw, dtype.plain()).reshape(shape, order=order)


class PickledColumns(Inert):
    """Stand-in for scipy's csc_matrix."""

    def array(self) -> np.ndarray:
        """The dense matrix."""
        rows, columns = self.state["_shape"]
        if not 0 < rows * columns <= ENTRY_LIMIT:
            raise AvatarError(f"a sparse matrix of {rows} x {columns} is too large")
        values, inner, starts = (as_array(self.state[key]) for key in ("data", "indices", "indptr"))
        outer = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        dense = np.zeros((rows, columns), values.dtype)
        np.add.at(dense, self.places(inner, outer), values)
        return dense

    def places(self, inner: np.ndarray, outer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each stored entry."""
        return inner, outer


class PickledRows(PickledColumns):
    """Stand-in for scipy's csr_matrix."""

    def places(self, inner: np.ndarray, outer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each stored entry."""
        return outer, inner


class PickledChumpy(Inert):
    """Stand-in for chumpy.ch.Ch, whose value is its attribute x."""

    def array(self) -> np.ndarray:
        """The value."""
        return as_array(self.state["x"])


class PickledSelection(Inert):
    """Stand-in for chumpy.reordering.Select: entries of another array, in another shape."""

    def array(self) -> np.ndarray:
        """The entries."""
        entries = as_array(self.state["a"]).ravel()[as_array(self.state["idxs"])]
        return entries.reshape(self.state["preferred_shape"]) if "preferred_shape" in self.state else entries


class PickledObject(Inert):
    """Stand-in for copyreg._reconstructor, by which Python 2 makes an object of a class."""

    def array(self) -> np.ndarray:
        """The value of the stand-in of that class, with this object's state."""
        twin = self.arguments[0]()
        twin.state = self.state
        return twin.array()


STAND_INS = {
    **{(f"numpy.{core}.multiarray", "_reconstruct"): PickledArray for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): Inert for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): PickledBuffer for core in ("core", "_core")},
    ("numpy", "ndarray"): PickledArray,
    ("numpy", "dtype"): PickledDtype,
    **{(f"scipy.sparse.{module}", "csc_matrix"): PickledColumns for module in ("csc", "_csc")},
    **{(f"scipy.sparse.{module}", "csr_matrix"): PickledRows for module in ("csr", "_csr")},
    ("chumpy.ch", "Ch"): PickledChumpy,
    ("chumpy.reordering", "Select"): PickledSelection,
    **{(module, "_reconstructor"): PickledObject for module in ("copy_reg", "copyreg")},
    **{(module, "object"): Inert for module in ("__builtin__", "builtins")},
    ("_codecs", "encode"): PickledBytes,
}


class InertUnpickler(pickle._Unpickler):
    """Unpickler that knows the stand-ins and nothing else: it imports no module and runs no code of the file.

    Python's own unpickler rather than the one in C, which a few bytes can make allocate gigabytes for its memo.
    """

    def find_class(self, module: str, name: str) -> type[Inert]:
        """The stand-in of a name; refuses any other name."""
        if (module, name) not in STAND_INS:
            raise pickle.UnpicklingError(f"refused {module}.{name}, which has no place in a file of arrays")
        return STAND_INS[module, name]


def as_array(value: Any) -> np.ndarray:
    """The numbers of a stand-in, or of a plain list."""
    array = value.array() if isinstance(value, Inert) else np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise AvatarError(f"not numbers but {array.dtype}")
    return array
