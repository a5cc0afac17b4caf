"""Conversion of foreign data to outfits of this project: packed frames with body, manifest and where they came from."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
import yaml

from avatar.body.model import BodyModel
from avatar.body.packed import write_body
from avatar.body.registry import canonical_name
from avatar.body.solving import posed_vertices
from avatar.checks import AvatarError, DataError, check_name, check_range
from avatar.data.folders import OUTFIT_FORMAT, SPLITS
from avatar.data.packed_layout import BODY, BODY_FILES, MEAN, PackedOutfit
from avatar.geometry.surface import interpolate, sample_surface
from avatar.io.documents import read_json
from avatar.io.frames import write_manifest
from avatar.io.ledger import Ledger, digest_of, file_digest, keyed
from avatar.io.locks import lock_folder
from avatar.io.meshes import write_mesh
from avatar.io.npz import write_arrays, write_whole
from avatar.io.points import color_bytes
from avatar.io.raw_surface import RawSurface, vertex_normals
from avatar.progress import tracked
from avatar.records import Frame, Mesh, Template
from avatar.settings import settings_to_dict
from avatar.sources.base import PosedScan, Source, SourceConfig, SourceFrame
from avatar.sources.normals import oriented_normals
from avatar.sources.published import split_frames

SOURCE = ("avatar.sources.conversion",)
PROVENANCE = "source.json"
FIT_KEYS = {"pose": "pose", "translation": "translation", "body_verts": "vertices", "vtransf": "vertex_transforms"}
FIT_KEYS |= {key: key for key in ("joint_transforms", "pose_vertices")}
FAST = 1  # level of deflating: a few percent larger than level 9, in a tenth of the time
log = logging.getLogger(__name__)


class UnfittedError(DataError):
    """A scan without a fitted body."""


@dataclass
class ConvertConfig(SourceConfig):
    """Conversion of a data set's outfits, or of one folder of scans, to outfits of this project."""

    data_root: Path = Path("data")
    dataset: str = "mine"  # the folder below data_root that outfits are written to
    name: str = ""  # of the outfit, where the source has one; that of its folder if empty
    test: float = 0.2  # share of frames that become the test split where there is none, the last of each sequence
    split: str = ""  # of a paper, where the layout has none: cape, scanimate or 4d-dress, in place of test
    start: int = 0  # first frame of each sequence
    stop: int | None = None  # the frame behind the last one; all of them if null
    step: int = 1  # every which frame is taken
    points: int | None = None  # a scan, sampled evenly from its mesh; its own vertices and faces if null
    skip_invalid: bool = False  # leave invalid frames out, named at the end, where conversion would stop otherwise

    def __post_init__(self):
        super().__post_init__()
        check_name("dataset", self.dataset)
        if self.name:
            check_name("name", self.name)
        check_range(self, "test", low=0, high=0.9)
        check_range(self, "start", low=0)
        check_range(self, "stop", "step", low=1)
        check_range(self, "points", low=100)


def convert_outfit(source: Source, config: ConvertConfig) -> Path:
    """Writes one outfit's frames below ``<data_root>/<dataset>``, or goes on with it; gives the outfit's folder.

    Frames are checked as they are when they are loaded for training; what is finished is not made again unless its
    files, the body or the settings have changed. ``source.json`` names every frame's files and their hashes. Raises
    `DataError` naming the file for an invalid frame (unless these are skipped), scans without a fitted body, and
    an outfit that another source was converted to.
    """
    folder = converted_folder(source, config)
    outfit = SourceOutfit(source, config)
    if source.body is None and source.mesh_template is None:
        raise DataError(source.path, "expected a body beside the scans or body.path, there is none.", source.body_hint)
    with lock_folder(folder.parent / ".locks" / folder.name):
        _claim(folder, source)
        ledger, failed = Ledger(folder), {}
        write_body_files(folder, source, ledger)
        settings = {"points": config.points, **source.decisions}
        bodies = {path.name: file_digest(path) for path in (*folder.glob("*.npz"), *folder.glob("*.obj"))}
        for frame in tracked(outfit.chosen, f"convert {source.name}"):
            path, label = folder / frame.split / f"{frame.name}.npz", f"{frame.split}/{frame.name}"
            made = source.made_of(frame)
            key = keyed((*SOURCE, type(source).__module__), files=made, bodies=bodies, settings=settings)
            if ledger.find(label, key) is not None:
                continue
            try:
                outfit.load(frame.split, frame.name)
            except AvatarError as error:
                if not config.skip_invalid:
                    raise
                failed[label] = str(error)
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            write_arrays(path, outfit.arrays, FAST)
            ledger.record(label, key, [path])
        if len(failed) == len(outfit.chosen):
            problem = f"expected valid frames, all {len(failed)} are invalid. The first: {next(iter(failed.values()))}"
            raise DataError(source.path, problem)
        _drop_others(folder, {f"{frame.split}/{frame.name}" for frame in outfit.chosen} - failed.keys())
        _write_provenance(folder, source, config, outfit.chosen, failed)
        write_manifest(folder)
    for label, problem in failed.items():
        log.warning("convert: left out %s: %s", label, problem)
    return folder


def converted_folder(source: Source, config: ConvertConfig) -> Path:
    """The folder that an outfit is converted to."""
    return Path(config.data_root) / config.dataset / (config.name or source.name)


class SourceOutfit(PackedOutfit):
    """A source as an outfit whose frames are loaded and checked without being converted to files.

    ``chosen`` are its frames with their splits; ``arrays`` those of the frame that was loaded last, as a packed file
    holds them.
    """

    def __init__(self, source: Source, config: ConvertConfig):
        super().__init__(source.path, config.dataset)
        self.name, self.source, self.points = config.name or source.name, source, config.points
        self.chosen = chosen_frames(source, config)
        if not self.chosen:
            raise DataError(source.path, f"expected frames of {source.name}, start, stop and step leave none.")
        self.arrays: dict[str, np.ndarray] = {}

    @property
    def body(self) -> BodyModel | None:
        return self.source.body

    @property
    def mean_body(self) -> BodyModel | None:
        return self.source.mean_body

    @cached_property
    def _listed(self) -> dict[str, tuple[str, ...]]:
        return {split: tuple(sorted(f.name for f in self.chosen if f.split == split)) for split in SPLITS}

    @cached_property
    def _by_name(self) -> dict[tuple[str, str], SourceFrame]:
        return {(frame.split, frame.name): frame for frame in self.chosen}

    def frame_path(self, split: str, name: str) -> Path:
        super().frame_path(split, name)
        return self._by_name[split, name].files[0]

    def read(self, split: str, name: str) -> PosedScan:
        """A frame as its files hold it, fitted or not."""
        return self.source.read(self._by_name[split, name])

    def _read_template(self) -> Template:
        if self.source.body is None and self.source.mesh_template is not None:
            return self.source.mesh_template
        return self.posable_body().template

    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        self.arrays = packed_arrays(self.source, self._by_name[split, name], self.points)
        return self.frame_of(dict(self.arrays), path, split, name)


def chosen_frames(source: Source, config: ConvertConfig) -> list[SourceFrame]:
    """The frames that are converted, each with its split: the layout's own, or the last of each sequence for testing.

    Single scans are one sequence, in the order of their names. At least one frame is left to train on. Raises
    `AvatarError` as `split_frames` for the split of a paper, and for one where the layout has its own.
    """
    frames, chosen = source.frames, []
    if config.split:
        if any(frame.split for frame in frames):
            raise AvatarError(f"split: expected none, as layout {source.layout} has its own, got {config.split}.")
        frames = split_frames(frames, source.name, config.split)
    for _, group in groupby(frames, key=lambda frame: (frame.split, frame.sequence)):
        taken = list(group)[config.start : config.stop : config.step]
        tested = min(round(config.test * len(taken)), len(taken) - 1)
        for place, frame in enumerate(taken):
            split = frame.split or ("test" if place >= len(taken) - tested else "train")
            chosen.append(replace(frame, split=split))
    return chosen


def packed_arrays(source: Source, frame: SourceFrame, points: int | None) -> dict[str, np.ndarray]:
    """A frame as the arrays of a packed npz (docs/data.md). Raises `UnfittedError` for a scan without a fitted body."""
    posed = source.read(frame)
    if not posed.fitted:
        problem = "expected a fitted body, nothing beside the scan says how it lies."
        raise UnfittedError(frame.files[0], problem, source.body_hint)
    arrays = {key: getattr(posed, name) for key, name in FIT_KEYS.items()}
    arrays |= scan_arrays(posed, posed_body(source, posed), points, frame.name)
    arrays["scan_name"] = np.array(frame.name)
    return {key: value for key, value in arrays.items() if value is not None}


def scan_arrays(posed: PosedScan, body: Mesh | None, points: int | None, name: str) -> dict[str, np.ndarray | None]:
    """A scan's arrays: as it is, or as ``points`` spread evenly over its mesh or taken from its points.

    Normals that are missing are the mesh's, or estimated from the points and oriented by the posed ``body``. Vertices
    of a mesh that no face with area gives one are left out. What is drawn follows from the frame's name alone.
    """
    scan, labels = posed.scan, posed.labels
    normals = scan.normals
    if normals is None:
        if scan.faces is not None:
            normals = vertex_normals(scan.vertices, scan.faces)
            scan, normals, labels = _without_loose_vertices(scan, normals, labels)
        else:
            normals = oriented_normals(scan.vertices, body, name)
    arrays = {"scan_pc": scan.vertices, "scan_n": normals, "scan_labels": labels, "scan_colors": scan.colors}
    if points is None:
        arrays["scan_faces"] = scan.faces
    elif scan.faces is not None:
        seed = int(digest_of(name)[:15], 16)
        samples = sample_surface(
            torch.from_numpy(scan.vertices), torch.from_numpy(scan.faces), points, torch.Generator().manual_seed(seed)
        )
        nearest = samples.vertex_ids.gather(1, samples.barycentric.argmax(dim=1, keepdim=True))[:, 0].numpy()
        for key in ("scan_pc", "scan_n", "scan_colors"):
            if arrays[key] is not None:
                arrays[key] = interpolate(torch.from_numpy(np.asarray(arrays[key], np.float32)), samples).numpy()
        arrays["scan_labels"] = None if labels is None else labels[nearest]
    elif len(scan.vertices) > points:
        kept = np.sort(np.random.default_rng(int(digest_of(name)[:15], 16)).permutation(len(scan.vertices))[:points])
        arrays = {key: None if value is None else value[kept] for key, value in arrays.items()}
    arrays["scan_n"] = arrays["scan_n"] / np.maximum(np.linalg.norm(arrays["scan_n"], axis=1, keepdims=True), 1e-12)
    if arrays["scan_colors"] is not None:
        arrays["scan_colors"] = color_bytes(arrays["scan_colors"])
    return arrays


def _without_loose_vertices(
    scan: RawSurface, normals: np.ndarray, labels: np.ndarray | None
) -> tuple[RawSurface, np.ndarray, np.ndarray | None]:
    """A mesh, its normals ``(V, 3)`` and labels ``(V,)`` without vertices whose normal is 0, and the faces at them."""
    kept = normals.any(axis=1)
    if kept.all():
        return scan, normals, labels
    faces = (np.cumsum(kept) - 1)[scan.faces[kept[scan.faces].all(axis=1)]]
    colors = None if scan.colors is None else scan.colors[kept]
    whole = replace(scan, vertices=scan.vertices[kept], faces=faces, colors=colors)
    return whole, normals[kept], None if labels is None else labels[kept]


def posed_body(source: Source, posed: PosedScan) -> Mesh | None:
    """The posed body: stored, or from its pose; None where it follows from transforms alone."""
    body, vertices = source.body, posed.vertices
    if vertices is None and body is not None and posed.pose is not None:
        vertices = posed_vertices(body, posed.pose, posed.translation)
    template = body if body is not None else source.mesh_template
    return None if vertices is None or template is None else Mesh(vertices, template.faces.numpy())


def write_body_files(folder: Path, source: Source, ledger: Ledger) -> None:
    """Writes the body at rest, the mean one and ``outfit.yaml``; `DataError` where the source has no body at all.

    A body that is there already is not written again: the blendshapes of SMPL-X take seconds to deflate.
    """
    settings: dict = {"format": OUTFIT_FORMAT, "layout": "packed", "source": f"{source.layout}: {source.name}"}
    if source.body is not None:
        bodies = {BODY: source.body} | ({} if source.mean_body is source.body else {MEAN: source.mean_body})
        for key, body in bodies.items():
            path, digest = folder / BODY_FILES[key], keyed(SOURCE, body=body_digest(body))
            if ledger.find(key, digest) is None:
                write_body(path, body, FAST)
                ledger.record(key, digest, [path])
            settings[key] = {"canonical": canonical_name(body)}
    elif (template := source.mesh_template) is not None:
        path = source.body_files[-1]
        if path.suffix == ".obj":
            write_whole(folder / "template.obj", path.read_bytes())  # with its UV atlas
        else:
            write_mesh(folder / "template.obj", Mesh(template.vertices.numpy(), template.faces.numpy()))
    else:
        problem = "expected a body beside the scans or body.path, there is none."
        raise DataError(source.path, problem, source.body_hint)
    write_whole(folder / "outfit.yaml", yaml.safe_dump(settings, sort_keys=False).encode())


def body_digest(body: BodyModel) -> str:
    """One hash over all that a body is made of."""
    found = hashlib.sha256(repr((body.parents, body.joint_names)).encode())
    for name, buffer in body.named_buffers():
        found.update(name.encode() + buffer.numpy().tobytes())
    return found.hexdigest()


def _claim(folder: Path, source: Source) -> None:
    """Refuses a folder that holds another outfit than this source's."""
    record = folder / PROVENANCE
    if record.is_file():
        known = read_json(record).get("source")
        if known != str(source.path.resolve()):
            problem = f"expected an outfit converted from {source.path.resolve()}, it is from {known}."
            raise DataError(folder, problem, "Hint: give this one another name=.")
    elif any((folder / split).is_dir() for split in SPLITS):
        raise DataError(
            folder, "expected a new folder, it holds frames of another origin.", "Hint: give another name=."
        )
    write_whole(record, json.dumps({"format": "source/1", "source": str(source.path.resolve())}).encode())


def _drop_others(folder: Path, kept: set[str]) -> None:
    """Removes frames of an earlier conversion with other settings."""
    for split in SPLITS:
        for path in (folder / split).glob("*.npz"):
            if f"{split}/{path.stem}" not in kept:
                path.unlink()


def _write_provenance(
    folder: Path, source: Source, config: ConvertConfig, frames: list[SourceFrame], failed: dict[str, str]
) -> None:
    """Writes ``source.json``: layout, settings, and the files and hashes that each frame was made from."""
    record = {
        "format": "source/1",
        "source": str(source.path.resolve()),
        "layout": source.layout,
        "settings": settings_to_dict(config),
        "decisions": source.decisions,
        "body": [str(path) for path in source.body_files],
        "frames": {
            f"{frame.split}/{frame.name}": {str(file): source.digest(file) for file in frame.files} for frame in frames
        },
        "left_out": failed,
    }
    write_whole(folder / PROVENANCE, f"{json.dumps(record, indent=1, default=str)}\n".encode())
