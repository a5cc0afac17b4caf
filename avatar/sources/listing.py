"""Files of a plain folder of scans: which are scans, in which order, and what the others hold, by their names."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from avatar.body.inert_pickle import read_pickled_arrays
from avatar.body.packed import holds_template
from avatar.checks import DataError, plain_name
from avatar.data.folders import SPLITS
from avatar.io.amass import KEYS
from avatar.io.documents import read_json_record
from avatar.io.rigs import RIG_SUFFIXES
from avatar.io.surfaces import READERS
from avatar.sources.base import SourceFrame

ARRAYS = (".npz", ".json", ".pkl")
LARGEST_PICKLE = 16 << 20  # bytes; body parameters have some kilobytes, models more
PASSED = {  # endings of what belongs to scans and is not read: materials, buffers, textures, notes
    *(".mtl", ".bin", ".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff", ".exr", ".webp", ".dds", ".ktx2"),
    *(".txt", ".md", ".pdf", ".html", ".yaml", ".yml", ".csv", ".log", ".ini", ".db", ".blend"),
}
FIT_FOLDERS = ("body", "bodies", "fit", "fits", "smpl", "smplh", "smplx", "params", "minimal")
BODY_STEMS = ("body", "template")
FIT_WORD = r"(?:body|smplh?|smplx|fit|fitted|minimal|params?|poses?)"
FIT_ENDING = re.compile(rf"[._-](?:mesh[._-])?{FIT_WORD}(?:[._-](?:mesh|{FIT_WORD}))*$")
NUMBERED = re.compile(r"^(.*?)(\d+)$")
VERTEX_KEYS = ("vertices", "verts", "body_verts")
FEWEST = 3  # scans in one folder whose names differ in their number alone, that are a sequence


@dataclass(frozen=True)
class ScanFolder:
    """One folder: the split and the sequence that its place says, empty where it says none; files in natural order."""

    path: Path
    split: str
    sequence: str
    scans: tuple[Path, ...]
    others: tuple[Path, ...]


def list_folders(path: Path, fits: Path | None = None) -> list[ScanFolder]:
    """A folder, its splits, its sequences and its splits' sequences, each with its files; ``fits`` is left out.

    Hidden files and folders, and folders of bodies such as smpl/, are passed over. Raises `DataError` for scans both in
    splits and beside them.
    """
    folders: list[ScanFolder] = []

    def visit(folder: Path, split: str, sequence: str) -> None:
        children = visible(folder)
        files = [child for child in children if child.is_file()]
        meshes = [file for file in files if file.suffix.lower() in READERS]
        stems = {mesh.stem.lower() for mesh in meshes}
        scans = tuple(mesh for mesh in meshes if not _is_body(mesh, stems))
        known = set(scans)
        others = tuple(file for file in files if file not in known)
        folders.append(ScanFolder(folder, split, sequence, scans, others))
        for child in children:
            if not child.is_dir() or is_fit_folder(child) or (fits is not None and child.samefile(fits)):
                continue
            if folder == path and child.name.lower() in SPLITS:
                visit(child, child.name.lower(), "")
            elif not sequence:
                visit(child, split, child.name)

    fits = fits if fits is not None and fits.exists() else None
    visit(path, "", "")
    splits = {folder.split for folder in folders if folder.scans}
    if "" in splits and len(splits) > 1:
        stray = next(folder.path for folder in folders if folder.scans and not folder.split)
        problem = f"expected scans in {', '.join(sorted(splits - {''}))} alone, got some in {stray} too."
        raise DataError(path, problem, "Hint: move them.")
    return folders


def list_frames(folders: Sequence[ScanFolder]) -> list[SourceFrame]:
    """The scans of folders as frames, sorted by split, sequence and number, without the files of their bodies.

    Scans whose names differ in their number alone are a sequence, and named ``<sequence>.<number>``; names that several
    splits have begin with the split. Raises `DataError` for two scans of one name, also where only their endings or
    their case differ.
    """
    frames = [frame for folder in folders for frame in _folder_frames(folder)]
    splits: dict[str, set[str]] = {}
    for frame in frames:
        splits.setdefault(frame.name.lower(), set()).add(frame.split)
    shared = {name for name, found in splits.items() if len(found) > 1}
    frames = [
        replace(frame, name=plain_name(f"{frame.split}-{frame.name}", "")) if frame.name.lower() in shared else frame
        for frame in frames
    ]
    names: dict[str, Path] = {}
    for frame in frames:
        other = names.setdefault(frame.name.lower(), frame.files[0])
        if other != frame.files[0]:
            problem = f"expected scans of different names, this one and {other} would both be {frame.name}."
            raise DataError(frame.files[0], problem, "Hint: rename one, or move one out of the folder.")
    return sorted(frames, key=lambda frame: (frame.split, frame.sequence, frame.number))


def _folder_frames(folder: ScanFolder) -> list[SourceFrame]:
    """Frames of one folder, in its order."""
    stems: dict[str, Path] = {}
    for scan in folder.scans:
        if (other := stems.setdefault(scan.stem.lower(), scan)) != scan:
            problem = f"expected one scan of that name, {other.name} is another."
            raise DataError(scan, problem, "Hint: rename one, or move one out of the folder.")
    groups: dict[str, list[tuple[int, Path]]] = {}
    for scan in folder.scans:
        if match := NUMBERED.match(scan.stem):
            groups.setdefault(match[1], []).append((int(match[2]), scan))
    sequences: dict[Path, tuple[str, int, int]] = {}
    for prefix, members in groups.items():
        alone = len(members) == len(folder.scans) and folder.sequence
        if len({number for number, _ in members}) == len(members) and (alone or len(members) >= FEWEST):
            stem = plain_name(prefix.rstrip("._- "), "scan")[:40]
            outer = plain_name(folder.sequence, "scan")[:20]
            name = outer if alone else f"{outer}-{stem}" if folder.sequence else stem
            width = max(len(str(number)) for number, _ in members)
            width = max(width, *(len(NUMBERED.match(scan.stem)[2]) for _, scan in members))
            sequences |= {scan: (name, number, min(width, 12)) for number, scan in members}
    frames = []
    for place, scan in enumerate(folder.scans):
        if scan in sequences:
            sequence, number, width = sequences[scan]
            name = f"{sequence}.{number:0{width}d}"
        else:
            sequence, number = plain_name(folder.sequence, "scan") if folder.sequence else "", -1
            name = plain_name(f"{folder.sequence}.{scan.stem}" if folder.sequence else scan.stem, f"scan{place}")
        frames.append(SourceFrame(name, folder.split, (scan,), sequence, number))
    return frames


def visible(folder: Path) -> list[Path]:
    """Files and folders of a folder in natural order, without hidden ones and what systems leave (Thumbs.db)."""
    left = ("thumbs.db", "desktop.ini", "__macosx", "icon\r")
    return sorted(
        (p for p in folder.iterdir() if not p.name.startswith(".") and p.name.lower() not in left), key=natural
    )


def natural(path: Path) -> list[tuple[int, int, str]]:
    """A key that orders names as people do: frame_2 before frame_10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part] + [(2, 0, path.name)]


def is_fit_folder(path: Path) -> bool:
    """Whether a folder's name says that it holds bodies."""
    return path.name.lower() in FIT_FOLDERS


def own_stem(path: Path) -> str:
    """The scan's name in lower case that a file's name has, without a word for bodies: walk_02 of walk_02_smpl.obj."""
    return FIT_ENDING.sub("", path.stem.lower())


def array_kind(path: Path) -> str:
    """What an npz, JSON or pickled file holds by its keys: body, parameters, vertices; empty for anything else."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".json":
            keys = set(read_json_record(path))
        elif suffix == ".pkl":
            keys = set(read_pickled_arrays(path, (), KEYS)) if path.stat().st_size <= LARGEST_PICKLE else set()
        else:
            with zipfile.ZipFile(path) as archive:
                keys = {name.removesuffix(".npy") for name in archive.namelist()}
    except (DataError, zipfile.BadZipFile, OSError):
        return ""
    if suffix == ".npz" and ({"v_template", "J_regressor"} <= keys or holds_template(path)):
        return "body"
    if keys & set(KEYS):
        return "parameters"
    return "vertices" if suffix == ".npz" and keys & set(VERTEX_KEYS) else ""


def _is_body(mesh: Path, stems: set[str]) -> bool:
    """Whether a mesh is a body: a rigged one, or named as a scan beside it, one of ``stems``, and a word for bodies."""
    if mesh.stem.lower() in BODY_STEMS and mesh.suffix.lower() in RIG_SUFFIXES:
        return True
    return own_stem(mesh) != mesh.stem.lower() and own_stem(mesh) in stems
