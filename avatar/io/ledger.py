"""What long work has finished: a line a piece in its folder, with the hash of its files and of all that made them."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from avatar.checks import DataError
from avatar.progress import WORK

LEDGER = ".finished.jsonl"


class Ledger:
    """The finished pieces of work in a folder, each by name, so that a command goes on where it stopped.

    A piece counts as finished when its key is the same (everything it was made from) and its files still have the
    sha256 they were written with; a damaged, changed or missing one is to be done again. Lines are only ever added,
    each sealed with its own hash: one that a killed process left half-written is passed over.
    """

    def __init__(self, folder: Path):
        """Reads what a folder's ledger says; a folder without one has finished nothing."""
        self.path = Path(folder) / LEDGER
        self.entries: dict[str, dict[str, Any]] = {}
        data = self.path.read_bytes() if self.path.is_file() else b""
        for line in data.splitlines():
            entry = _unseal(line)
            if entry is not None:
                self.entries[entry["name"]] = entry
        self.torn = bool(data) and not data.endswith(b"\n")

    def find(self, name: str, key: str) -> Any:
        """What was noted of a finished piece (`True` where nothing was), or None where it has to be done."""
        entry = self.entries.get(name)
        if entry is None or entry["key"] != key:
            return None
        for file, digest in entry["files"].items():
            path = self.path.parent / file
            if not path.is_file() or file_digest(path) != digest:
                return None
        WORK["found"] += 1
        return True if entry["note"] is None else entry["note"]

    def record(self, name: str, key: str, files: Iterable[Path] = (), note: Any = None) -> None:
        """Notes a finished piece: its files, which are on the disk already, or plain values.

        Raises:
            DataError: when the disk refuses.
        """
        folder = self.path.parent
        listed = {os.path.relpath(path, folder): file_digest(path) for path in files}
        entry = {"name": name, "key": key, "files": listed, "note": note}
        line = json.dumps({**entry, "seal": digest_of(entry)}).encode() + b"\n"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as stream:
                stream.write(b"\n" * self.torn + line)
        except OSError as error:
            mend = "Make room and give the same command again."
            raise DataError(self.path, f"could not be written ({error.strerror}).", mend) from error
        self.torn, self.entries[name] = False, entry
        WORK["made"] += 1


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
    """One hash over the files that stand directly in a folder: what its frames share.

    Hidden ones are left out, and the manifest, which lists the frames and so changes with each.
    """
    shared = (path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    paths = sorted(path for path in shared if path.name != "manifest.json")
    return digest_of({path.name: file_digest(path) for path in paths})


@functools.cache
def code_digest() -> str:
    """One hash over this program's own source: what another version made is not taken for what this one would."""
    root = Path(__file__).parents[1]
    return digest_of({str(path.relative_to(root)): file_digest(path) for path in sorted(root.rglob("*.py"))})


def keyed(**parts: Any) -> str:
    """The key of a piece of work: one hash over all that it is made from, this program's source included."""
    return digest_of({"code": code_digest(), **parts})
