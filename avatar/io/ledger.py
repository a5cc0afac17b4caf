"""What long work has finished: a line a piece in its folder, with the hash of its files and of all that made them."""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from itertools import accumulate
from pathlib import Path
from typing import Any

from avatar.checks import DataError
from avatar.io.locks import lock_file
from avatar.progress import WORK

LEDGER = ".finished.jsonl"
PACKAGE = Path(__file__).parents[1]


def read_sources(package: Path) -> dict[str, bytes]:
    """The source of every module of this package by dotted name, from a folder that holds it."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = ("avatar", *path.relative_to(package).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_bytes()
    return found


SOURCES = read_sources(PACKAGE)  # as the program began: a file edited while it runs is not what it computes with


class Ledger:
    """The finished pieces of work in a folder, each by name and key, so that a command goes on where it stopped.

    A key is a hash of everything a piece was made from; a piece is finished when its files still have the sha256 they
    were written with. Lines are only added, under a lock, each with its own hash: a half-written one is passed over.
    """

    def __init__(self, folder: Path):
        self.path = Path(folder) / LEDGER
        self.entries: dict[str, dict[str, dict[str, Any]]] = {}  # by name and key
        lines = self.path.read_bytes().splitlines() if self.path.is_file() else ()
        self._keep(filter(None, map(_unseal, lines)))

    def find(self, name: str, key: str) -> Any:
        """What was noted of a finished piece (`True` where nothing was), or None where it has to be done."""
        entry = self.entries.get(name, {}).get(key)
        if entry is None:
            return None
        paths = {self.path.parent / file: digest for file, digest in entry["files"].items()}
        if not all(path.is_file() and file_digest(path) == digest for path, digest in paths.items()):
            return None
        WORK["found"] += 1
        return True if entry["note"] is None else entry["note"]

    def record(self, name: str, key: str, files: Iterable[Path] = (), note: Any = None) -> None:
        """Notes a finished piece: its files, which are on the disk already, or plain values.

        Raises `DataError` when the disk refuses.
        """
        listed = {os.path.relpath(path, self.path.parent): file_digest(path) for path in files}
        self._append([{"name": name, "key": key, "files": listed, "note": note}])

    def record_notes(self, key: str, notes: Mapping[str, Any]) -> None:
        """Notes several finished pieces of one key, each by name with its plain values, as `record` does."""
        self._append([{"name": name, "key": key, "files": {}, "note": note} for name, note in notes.items()])

    def _append(self, entries: list[dict[str, Any]]) -> None:
        """Adds lines at the end of the file, behind those that other processes have added meanwhile."""
        lines = b"".join(json.dumps({**entry, "seal": digest_of(entry)}).encode() + b"\n" for entry in entries)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a+b") as stream:
                lock_file(stream)
                if size := stream.seek(0, os.SEEK_END):
                    stream.seek(size - 1)
                    lines = lines if stream.read(1) == b"\n" else b"\n" + lines  # behind a half-written line
                stream.write(lines)
        except OSError as error:
            hint = "Free disk space and give the same command again."
            raise DataError(self.path, f"could not be written ({error.strerror}).", hint) from error
        self._keep(entries)
        WORK["made"] += len(entries)

    def _keep(self, entries: Iterable[dict[str, Any]]) -> None:
        for entry in entries:
            self.entries.setdefault(entry["name"], {})[entry["key"]] = entry


def _unseal(line: bytes) -> dict[str, Any] | None:
    """The entry of a line, or None for a damaged one."""
    try:
        entry = json.loads(line)
        seal = entry.pop("seal")
        whole = set(entry) == {"name", "key", "files", "note"} and isinstance(entry["files"], dict)
        inside = whole and all(Path(file).parts[:1] != ("/",) for file in entry["files"])
        return entry if inside and seal == digest_of(entry) else None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def digest_of(values: Any) -> str:
    """The sha256 of plain values, whatever the order of keys; paths and the like count by their text."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """The sha256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def files_digest(folder: Path) -> str:
    """One hash over the visible files directly in a folder but the manifest: what its frames share."""
    shared = (path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    paths = sorted(path for path in shared if path.name != "manifest.json")
    return digest_of({path.name: file_digest(path) for path in paths})


@functools.cache
def source_digest(*modules: str) -> str:
    """One hash over the code of modules of this package and of all that they import from it, directly or not."""
    found, new = set(), set(modules)
    while new:
        found |= new
        new = {other for name in new for other in imported_modules(name)} - found
    return digest_of({name: module_digest(name) for name in found})


@functools.cache
def module_digest(module: str) -> str:
    """A hash over the code of one module of this package alone; comments and line breaks do not count."""
    return hashlib.sha256(ast.dump(ast.parse(SOURCES[module])).encode()).hexdigest()


def imported_modules(module: str) -> set[str]:
    """The modules of this package that one of them imports, inside its functions too, and the packages they are in."""
    names = set()
    for node in ast.walk(ast.parse(SOURCES[module])):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            base = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
            names |= {f"{base}{alias.name}" for alias in node.names}
    return {part for name in names for part in accumulate(name.split("."), "{}.{}".format)} & SOURCES.keys()


def keyed(source: tuple[str, ...], **parts: Any) -> str:
    """The key of a piece of work: one hash over all that it is made from, and over the modules that make it."""
    return digest_of({"source": source_digest(*source), **parts})
