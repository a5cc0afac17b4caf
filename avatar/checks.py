"""Checks at public borders: shapes, finite values, optional packages, and the one error users see."""

from __future__ import annotations

import difflib
import importlib
import math
import re
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from avatar.invocation import install_line

SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")  # of what becomes a file or folder of ours


class AvatarError(ValueError):
    """Bad input. The message names the argument or file, what was expected, what came and what to do."""


class DataError(AvatarError):
    """A file that is missing, damaged or does not hold what it should."""

    def __init__(self, path: str | Path, problem: str, hint: str = ""):
        self.path = Path(path)
        super().__init__(sentences(f"{path}: {problem}", hint, nearest_folder(self.path)))


def sentences(*parts: str) -> str:
    """A message of those of its parts that are not empty."""
    return " ".join(filter(None, parts))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The known word nearest to one that is not known, as a question; empty where none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"Did you mean {near[0]!r}?" if near else ""


def unknown_name(what: str, word: str, known: Iterable[str]) -> AvatarError:
    """The error of an option ``what`` whose value is none of the known names."""
    known = list(known)
    message = f"{what}: expected one of {', '.join(known)}, got {word!r}."
    return AvatarError(sentences(message, did_you_mean(word, known)))


def nearest_folder(path: Path) -> str:
    """The folder that a mistyped path may have meant, as a question; empty where none is near or nothing is wrong."""
    wanted = path.parent
    if wanted.exists():
        return ""
    there = next(parent for parent in wanted.parents if parent.exists())
    for part in wanted.relative_to(there).parts:
        names = [folder.name for folder in there.iterdir() if folder.is_dir()] if there.is_dir() else []
        near = [part] if part in names else difflib.get_close_matches(part, names, n=1)
        if not near:
            return ""
        there = there / near[0]
    return f"Did you mean {str(there)!r}?"


def check_name(what: str, name: str) -> str:
    """The name again, if it may become a file or a folder that stays where it is put.

    Raises `AvatarError` for one with slashes, drives, control characters or blanks, hidden, empty, too long.
    """
    if not isinstance(name, str) or not SAFE_NAME.fullmatch(name):
        form = "a plain name (letters, digits, '_', '.', '-', at most 64)"
        raise AvatarError(f"{what}: expected {form}, got {name!r:.200}.")
    return name


def check_trained(path: Path) -> tuple[Path, Path]:
    """The files of weights and of their description, ``path`` with two endings; raises `DataError` without one."""
    files = path.with_suffix(".safetensors"), path.with_suffix(".json")
    for file in files:
        if not file.is_file():
            raise DataError(file, "no such file.", "Train the run first (tools/train.py).")
    return files


def plain_name(text: str, otherwise: str) -> str:
    """The nearest plain name to what a file calls itself; ``otherwise`` where nothing of it is left."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text).lstrip("_.-")[:64] or otherwise


def check_range(
    settings: Any, *names: str, low: float = -math.inf, above: float = -math.inf, high: float = math.inf
) -> None:
    """Refuses settings of which a named field is below ``low``, not ``above`` a number or beyond ``high``.

    None, which stands for no limit, passes. Raises `AvatarError` naming the field, its range and its value.
    """
    bounds = {"at least": low, "above": above, "at most": high}
    expected = " and ".join(f"{word} {bound}" for word, bound in bounds.items() if math.isfinite(bound))
    for name in names:
        value = getattr(settings, name)
        if value is not None and not (low <= value <= high and value > above):
            raise AvatarError(f"{name}: expected {expected}, got {value}.")


def check_shape(name: str, value: Any, pattern: str, **dims: int) -> dict[str, int]:
    """Checks an array or tensor against a pattern such as ``"B N 3"`` and returns its named sizes.

    A number in the pattern is a fixed size, a name is bound at its first use (or by ``dims``) and must agree
    afterwards, and a leading ``...`` stands for any number of dimensions. Raises `AvatarError` naming the argument, the
    expected pattern and the shape that came.
    """
    sizes, expected, shape = dict(dims), pattern.split(), tuple(getattr(value, "shape", ()))
    tail = shape
    if expected[:1] == ["..."]:
        expected = expected[1:]
        tail = shape[max(0, len(shape) - len(expected)) :]
    wanted = [int(token) if token.isdigit() else sizes.setdefault(token, size) for token, size in zip(expected, tail)]
    if len(tail) != len(expected) or list(tail) != wanted:
        bound = ", ".join(f"{key}={sizes[key]}" for key in pattern.split() if key in dims)
        form = f"({', '.join(pattern.split())})" + (f" with {bound}" if bound else "")
        came = shape if hasattr(value, "shape") else type(value).__name__
        raise AvatarError(f"{name}: expected shape {form}, got {came}.")
    return sizes


def check_finite(name: str, value: Any) -> None:
    """Raises `AvatarError` for NaN or infinity in an array or tensor: how many, and the index of the first."""
    array = value.detach().cpu().numpy() if hasattr(value, "detach") else np.asarray(value)
    bad = ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise AvatarError(
            f"{name}: expected finite numbers, got {int(bad.sum())} NaN or infinite values of {array.size} "
            f"(first at index {first}). Remove or repair them before going on."
        )


def check_oriented(points: Any, normals: Any) -> dict[str, int]:
    """Checks points and normals ``(N, 3)`` for their shapes and finite values; gives N."""
    dims = check_shape("points", points, "N 3")
    check_shape("normals", normals, "N 3", **dims)
    check_finite("points", points)
    check_finite("normals", normals)
    return dims


def check_faces(faces: np.ndarray, count: int) -> None:
    """Checks triangles ``(F, 3)``: at least one, of whole numbers, all indices of ``count`` vertices."""
    check_shape("faces", faces, "F 3")
    if not len(faces) or not np.issubdtype(faces.dtype, np.integer):
        raise AvatarError(f"faces: expected triangles of whole numbers, got {len(faces)} of {faces.dtype}.")
    if faces.min() < 0 or faces.max() >= count:
        raise AvatarError(f"faces: expected vertex indices in [0, {count}), got {faces.min()} to {faces.max()}.")


def check_suffix(path: Path, endings: Iterable[str], what: str) -> str:
    """The ending of a file's name in lower case; raises `DataError` for one that is none of ``endings``."""
    if (suffix := path.suffix.lower()) not in endings:
        raise DataError(path, f"expected {what} ending in {' or '.join(endings)}, got {path.suffix!r}.")
    return suffix


def check_file(path: Path, limit: int) -> None:
    """Raises `DataError` for a file, before it is read, that is missing, empty or larger than ``limit`` bytes."""
    if not path.is_file():
        raise DataError(path, "there is no such file.")
    if not 0 < (size := path.stat().st_size) <= limit:
        raise DataError(path, f"expected at most {limit} and at least 1 bytes, got {size}.")


def require(package: str) -> ModuleType:
    """Imports an optional package at the place of its use.

    Raises `AvatarError`, with the line to run, when the package or one of its libraries is missing.
    """
    try:
        return importlib.import_module(package)
    except (ImportError, OSError) as error:
        line = install_line(package.partition(".")[0])
        raise AvatarError(f"{package} is needed here and cannot be imported ({error}). Run: {line}") from error
