"""The one interface to data in a foreign layout: an outfit's frames, each a scan with what is known of its body."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from avatar.body.model import BodyModel
from avatar.checks import DataError, plain_name, unknown_name
from avatar.geometry.units import METRES
from avatar.invocation import command_line, option
from avatar.io.ledger import file_digest
from avatar.io.raw_surface import RawSurface
from avatar.records import Mesh, Template

UPS = ("y", "z", "-y", "-z", "x", "-x")


@dataclass
class SourceBody:
    """The subject's body, where the layout does not bring it itself."""

    path: Path | None = None  # a converted SMPL, SMPL-H or SMPL-X model, a template.npz, or a rigged GLB
    betas: list[float] = field(default_factory=list)  # shape, standard deviations; those beside the scans if empty
    all_joints: bool | None = None  # true keeps hands and face, false lays them at rest (22 joints); null: as poses do
    canonical: str = "t"  # t, or apart (hips 25 degrees outwards, for skirts)


@dataclass
class SourceConfig:
    """Which data are read, and what their files do not say."""

    source: Path = Path("data/scans")  # the data set, or the folder of one outfit's scans
    layout: str = "auto"  # auto takes the one whose files are there
    outfits: list[str] = field(default_factory=list)  # of a data set with several; all of them if empty
    units: str = "auto"  # of scans, where the layout fixes none: m, cm, mm, in; auto takes that of a person's height
    up: str = "auto"  # the axis that points up, as units: y, z, -y, -z, x, -x; auto takes the one people stand along
    body: SourceBody = field(default_factory=SourceBody)
    fits: Path | None = None  # body parameters or meshes, one a scan or one for all; those beside the scans if null

    def __post_init__(self):
        if self.units not in ("auto", *METRES):
            raise unknown_name("units", self.units, ("auto", *METRES))
        if self.up not in ("auto", *UPS):
            raise unknown_name("up", self.up, ("auto", *UPS))


@dataclass(frozen=True)
class SourceFrame:
    """One frame by the files that it is made of, unread.

    ``name`` is a plain name, unique in its outfit; ``split`` is train, test or interpolation, empty where the layout
    does not say; ``files`` has the scan's first. ``sequence`` and ``number`` order frames in time, ``number`` -1 for
    single scans.
    """

    name: str
    split: str
    files: tuple[Path, ...]
    sequence: str = ""
    number: int = -1


@dataclass(frozen=True)
class PosedScan:
    """A scan and what its files say of the body under it: metres, y up, right-handed, all in the same coordinates.

    Transforms are posed_from_canonical, as in `avatar.records.BodyFit`; ``vertex_transforms`` may be rotations alone.
    What is unknown is None: no ``pose``, ``vertices`` or transform at all is a scan without a fitted body.
    """

    scan: RawSurface
    pose: np.ndarray | None = None  # (J, 3) axis-angle, radians, relative to the parent and to the T-pose
    translation: np.ndarray | None = None  # (3,) metres, added last
    vertices: np.ndarray | None = None  # (V, 3) posed body
    vertex_transforms: np.ndarray | None = None  # (V, 4, 4) or (V, 3, 3)
    joint_transforms: np.ndarray | None = None  # (J, 4, 4)
    pose_vertices: np.ndarray | None = None  # (V, 3) what a pose encoder sees
    labels: np.ndarray | None = None  # (M,) uint8 of the scan's vertices: 0 is skin, then one number a garment

    @property
    def fitted(self) -> bool:
        """Whether anything says how the body lies."""
        parts = (self.pose, self.vertices, self.vertex_transforms, self.joint_transforms)
        return any(part is not None for part in parts)


def sorted_frames(path: Path, frames: Iterable[SourceFrame]) -> tuple[SourceFrame, ...]:
    """Frames by split, sequence and number; `DataError` where two have one name."""
    found = sorted(frames, key=lambda frame: (frame.split, frame.sequence, frame.number, frame.name))
    seen: dict[tuple[str, str], SourceFrame] = {}
    for frame in found:
        other = seen.setdefault((frame.split, frame.name), frame)
        if other is not frame:
            problem = f"expected every frame once, {other.files[0]} and {frame.files[0]} are both called {frame.name}."
            raise DataError(path, problem, "Hint: rename one.")
    return tuple(found)


def numbered(stem: str) -> tuple[str, int]:
    """Sequence and number that a file's name without its ending holds; number -1 where it ends in no digits."""
    match = re.fullmatch(r"(.*?)[._-]?f?(\d{1,12})", stem)
    return (match[1], int(match[2])) if match else (stem, -1)


def subfolders(path: Path) -> list[Path]:
    """The visible folders in a folder, sorted; none of what is no folder."""
    if not path.is_dir():
        return []
    return sorted(folder for folder in path.iterdir() if folder.is_dir() and not folder.name.startswith("."))


def outfits_at(folders: Iterable[Path]) -> dict[str, Path]:
    """Outfits by plain names from their folders; `DataError` where two have one name."""
    found: dict[str, Path] = {}
    for folder in folders:
        name = plain_name(folder.resolve().name, "outfit")
        if found.setdefault(name, folder) != folder:
            raise DataError(folder, f"expected every outfit once, {found[name]} has the name {name} too.")
    return found


class Source(ABC):
    """One outfit of a data set in a foreign layout; nothing of it is ever written to.

    Frames are listed by their names alone and read one at a time. Raises `DataError` naming the file for what is
    missing or invalid, with the layout that is expected and where the data are to be had.
    """

    layout: ClassVar[str]
    expected: ClassVar[str] = ""  # the files of the layout, a tree of a few lines
    home: ClassVar[str] = ""  # where data of this layout are to be had

    def __init__(self, path: Path, name: str, config: SourceConfig):
        self.path, self.name, self.config = Path(path), name, config
        self.digest = cache(file_digest)  # a file of several frames is read once

    @classmethod
    def missing(cls, path: Path, problem: str) -> DataError:
        """The error of files that are not there: the layout that is expected, and where such data are to be had."""
        home = f"\nTo be had at {cls.home}." if cls.home else ""
        return DataError(path, problem, f"Hint: layout {cls.layout} has\n{cls.expected}{home}")

    @classmethod
    @abstractmethod
    def find(cls, path: Path) -> dict[str, Path]:
        """Outfits of this layout in a folder: plain names and where each lies; empty for another layout."""

    @cached_property
    @abstractmethod
    def frames(self) -> tuple[SourceFrame, ...]:
        """The outfit's frames, sorted by split, sequence and number."""

    @abstractmethod
    def read(self, frame: SourceFrame) -> PosedScan:
        """A frame from its files."""

    def made_of(self, frame: SourceFrame) -> list[str]:
        """Hashes of all that a frame is made from but the body."""
        return [self.digest(file) for file in frame.files]

    def body_mesh(self, frame: SourceFrame) -> Mesh | None:
        """The mesh of any body that was fitted to a frame's scan, metres, y up: what another body is fitted to.

        None where the frame has none.
        """
        return None

    @property
    def decisions(self) -> dict[str, str]:
        """What was found for all of the outfit's frames where its files do not say it, such as units and axes."""
        return {}

    @property
    def body(self) -> BodyModel | None:
        """The subject's body; None where none is known."""
        return None

    @property
    def mean_body(self) -> BodyModel | None:
        """The body of mean shape that pose encoders see; the subject's own where the layout has no other."""
        return self.body

    @property
    def body_hint(self) -> str:
        """How the outfit gets a body, where it has none."""
        return f"Hint: fit one: {command_line('data_fit', option('source', self.path))}"

    @property
    def mesh_template(self) -> Template | None:
        """The minimal body's mesh at rest where that is all that is known of it (POP's layout); None otherwise."""
        return None

    @property
    def body_files(self) -> tuple[Path, ...]:
        """The files that the body comes from."""
        return ()
