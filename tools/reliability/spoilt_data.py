"""People's own data with one fault each, read as the commands do: what came of it, as findings and as a table."""

from __future__ import annotations

import logging
import re
import shutil
import textwrap
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from avatar.checks import AvatarError
from avatar.data.folders import SPLITS
from avatar.data.layouts import open_outfit_folder
from avatar.data.splits import split_outfit
from avatar.geometry.surface import vertex_normals
from avatar.io.motions import read_motion
from avatar.io.npz import write_whole
from avatar.io.surfaces import read_surface
from reliability.findings import Finding, all_of, none_of
from reliability.spoilt import FRAME, READ, REFUSED, WARNED, Base, Result, Spoilt, save
from reliability.spoilt_files import MESHES, MOTIONS, Shape
from reliability.spoilt_fits import FITS
from reliability.spoilt_folders import BODIES, FOLDERS
from reliability.spoilt_scans import SCANS

SHOWN = 240  # characters of a message in the table
AGAIN = " (Others like it are not mentioned.)"


def all_spoilt() -> list[Spoilt]:
    """Every way to spoil data, part by part."""
    parts = {"scan": SCANS, "fit": FITS, "body": BODIES, "folder": FOLDERS, "motion": MOTIONS}
    found = [Spoilt(part, *row) for part, rows in parts.items() for row in rows]
    return found + [Spoilt("mesh", *row[:3], row[3:]) for row in MESHES]


@contextmanager
def recorded() -> Iterator[list[str]]:
    """Warnings of the package within the block."""
    found: list[str] = []

    class Recorder(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record.getMessage())

    log, handler = logging.getLogger("avatar"), Recorder(logging.WARNING)
    log.addHandler(handler)
    try:
        yield found
    finally:
        log.removeHandler(handler)


def read_spoilt(spoilt: Spoilt, base: Base, folder: Path) -> Result:
    """Spoils data in a folder, reads it as the commands do, and records what came of it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    untyped = ""
    with recorded() as warnings:
        try:
            READERS[spoilt.part](spoilt, base, folder)
            outcome, message = (WARNED, " ".join(warnings)) if warnings else (READ, "")
        except AvatarError as error:
            outcome, message = REFUSED, str(error)
        except Exception as error:
            outcome, message, untyped = REFUSED, repr(error), type(error).__name__
    return Result(spoilt, outcome, message.replace(f"{folder}/", ""), untyped)


def _read_frame(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "template.npz", base.body)
    save(folder / FRAME, spoilt.spoil(base.copy(base.frames[FRAME]), base))
    open_outfit_folder(folder).load("train", "walk.00000")


def _read_body(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "template.npz", spoilt.spoil(base.copy(base.body), base))
    save(folder / FRAME, {k: v for k, v in base.frames[FRAME].items() if k not in ("body_verts", "vtransf")})
    open_outfit_folder(folder).load("train", "walk.00000")


def _read_folder(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "template.npz", base.body)
    for path, arrays in base.frames.items():
        save(folder / path, arrays)
    spoilt.spoil(folder, base)
    outfit = open_outfit_folder(folder)
    split_outfit(outfit)
    for split in SPLITS:
        for name in outfit.frames(split) if outfit.has_frames(split) else ():
            outfit.load(split, name)


def _read_motion(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "walk.npz", spoilt.spoil(base.copy(base.motion), base))
    read_motion(folder / "walk.npz")


def _read_mesh(spoilt: Spoilt, base: Base, folder: Path) -> None:
    ending, write = spoilt.spoil
    vertices, faces = base.body["vertices"], base.body["faces"].astype(np.int64)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    (folder / f"scan{ending}").write_bytes(write(Shape(vertices, faces, normals)))
    assert read_surface(folder / f"scan{ending}").mesh is not None


READERS = {"scan": _read_frame, "fit": _read_frame, "body": _read_body, "folder": _read_folder}
READERS |= {"motion": _read_motion, "mesh": _read_mesh}


def spoilt_trial(root: Path, out: Path) -> list[Finding]:
    """Reads data spoilt in every way, and counts what came of it; the table of all goes to ``<out>/spoilt_data.md``."""
    base = Base(root)
    results = [read_spoilt(spoilt, base, root / "data") for spoilt in all_spoilt()]
    write_whole(out / "spoilt_data.md", spoilt_table(results).encode())
    met = Counter(result.outcome for result in results if result.met)
    wanted, total = Counter(result.spoilt.wanted for result in results), len(results)
    found = {
        READ: "valid in another form, and read",
        WARNED: "doubtful, read with a warning that has figure and cause",
        REFUSED: "harmful, refused with file and true cause",
    }
    return [
        *(all_of("spoilt", words, met[outcome], wanted[outcome]) for outcome, words in found.items()),
        none_of("spoilt", "harmful or doubtful and read in silence", sum(r.silent for r in results), total),
        none_of("spoilt", "refused with an untyped error", sum(bool(r.untyped) for r in results), total),
    ]


def spoilt_table(results: list[Result]) -> str:
    """What was spoilt and what came of it, as Markdown."""
    lines = ["| data | what is spoilt | came of it | figure and cause |", "|---|---|---|---|"]
    for result in results:
        message = re.sub(r"\s+", " ", result.message.partition(": ")[2]).replace("|", "\\|").replace(AGAIN, "")
        shown = textwrap.shorten(message, SHOWN, placeholder=" ...")
        lines.append(f"| {result.spoilt.part} | {result.spoilt.words} | {result.outcome} | {shown} |")
    return "\n".join(lines) + "\n"
