"""`data info`, `check`, `convert` and `fit`: what other people's data hold, measured, and made outfits of ours."""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields
from pathlib import Path

from avatar.checks import AvatarError, check_range, unknown_name
from avatar.data.folders import SPLITS
from avatar.data.layouts import open_outfit_folder
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.evaluation.scores import csv_text
from avatar.io.npz import write_whole
from avatar.sources.base import Source, SourceConfig
from avatar.sources.conversion import ConvertConfig, SourceOutfit, UnfittedError, convert_outfit
from avatar.sources.findings import Findings, FrameFinding, describe, measure_outfit
from avatar.sources.registered import FitScansConfig, fit_outfit_body
from avatar.sources.registry import open_sources

log = logging.getLogger(__name__)


@dataclass
class InfoConfig(SourceConfig):
    """What a data set or a folder of scans holds, from its files' names and one frame."""


@dataclass
class CheckConfig(SourceConfig):
    """Measures of the frames of a data set, of a folder of scans, or of outfits of this project."""

    frames: int | None = 20  # of each split, evenly spaced; all of them if null
    out: Path | None = None  # a CSV file with a row a frame

    def __post_init__(self):
        super().__post_init__()
        check_range(self, "frames", low=1)


@prepared_process()
def data_info(config: InfoConfig) -> list[Path]:
    """Prints one screen on the outfits of a source: layout, splits, sequences, the first frame and the body.

    Raises `DataError` for a folder of no known layout, or whose first frame cannot be read.
    """
    for outfit in opened_outfits(config):
        print("\n  ".join([f"{outfit.name}:", *_facts(outfit)]))
    return []


@prepared_process()
def data_check(config: CheckConfig) -> list[Path]:
    """Prints what the frames of each outfit of a source measure, and what is doubtful about them.

    Raises `AvatarError` at the end where frames are invalid, with their number and the first one's reason.
    """
    found = {outfit.name: measure_outfit(outfit, config.frames) for outfit in opened_outfits(config)}
    for name, findings in found.items():
        print("\n  ".join([f"{name}:", *describe(findings)]))
    if config.out is not None:
        write_findings(config.out, found)
    invalid = [(name, frame) for name, findings in found.items() for frame in findings.invalid]
    if invalid:
        name, frame = invalid[0]
        total = sum(len(findings.frames) for findings in found.values())
        raise AvatarError(f"{len(invalid)} of {total} frames are invalid. The first, of {name}: {frame.problem}")
    return [config.out] if config.out else []


@prepared_process()
def data_convert(config: ConvertConfig) -> list[Path]:
    """Converts every outfit of a source (`convert_outfit`); gives their folders.

    Raises `AvatarError` where one ``name`` is given for several outfits.
    """
    return [convert_outfit(source, config) for source in several_sources(config)]


@prepared_process()
def data_fit(config: FitScansConfig) -> list[Path]:
    """Fits a body to the scans of every outfit of a source and converts them with it (`fit_outfit_body`).

    Raises `AvatarError` where one ``name`` is given for several outfits.
    """
    written = []
    for source in several_sources(config):
        folder, failed = fit_outfit_body(source, config)
        for name in failed:
            log.warning("fit: no body fits %s of %s: %s", name, source.name, folder / "fits" / "fits.md")
        written.append(folder)
    return written


def several_sources(config: ConvertConfig) -> list[Source]:
    """The outfits of a source. Raises `AvatarError` where one ``name`` is given for several."""
    sources = open_sources(config)
    if config.name and len(sources) > 1:
        listed = ", ".join(source.name for source in sources)
        raise AvatarError(f"name: expected none for several outfits, got {config.name!r} for {listed}.")
    return sources


def opened_outfits(config: SourceConfig) -> list[Outfit]:
    """The outfits of a source, or of a folder of this project's own data."""
    path = Path(config.source)
    if (path / "outfit.yaml").is_file():
        return [open_outfit_folder(path)]
    own = [folder for folder in sorted(path.glob("*/")) if (folder / "outfit.yaml").is_file()]
    if own and config.layout == "auto":
        for name in config.outfits:
            if name not in (known := [folder.name for folder in own]):
                raise unknown_name("outfits", name, known)
        return [open_outfit_folder(folder) for folder in own if not config.outfits or folder.name in config.outfits]
    options = ConvertConfig(**{entry.name: getattr(config, entry.name) for entry in fields(SourceConfig)})
    return [SourceOutfit(source, options) for source in open_sources(config)]


def _facts(outfit: Outfit) -> list[str]:
    """Lines on an outfit, from the names of its files and its first frame."""
    source: Source | None = getattr(outfit, "source", None)
    sizes = {split: outfit.frames(split) for split in SPLITS if outfit.has_frames(split)}
    lines = [f"layout: {source.layout if source else 'this project'}, in {outfit.path}"]
    if source:
        sequences = {frame.sequence for frame in source.frames} - {""}
        given = "as the layout has them" if any(frame.split for frame in source.frames) else "by test=, the last frames"
        lines += [f"{what}: {found}" for what, found in source.decisions.items()]
        lines.append(f"sequences: {len(sequences) or 'single scans'}; splits {given}")
    lines.append("frames: " + ", ".join(f"{len(names)} {split}" for split, names in sizes.items()))
    split, names = next(iter(sizes.items()))
    try:
        scan = outfit.load(split, names[0]).scan
        points, body = len(scan.points), _body_facts(outfit)
    except UnfittedError:
        scan = outfit.read(split, names[0]).scan
        points, body = len(scan.vertices), f"none beside the scans. {outfit.source.body_hint}"
    kind = f"{points:,} points" if scan.faces is None else f"mesh of {len(scan.faces):,} faces"
    colors = "" if scan.colors is None else ", coloured"
    return [*lines, f"first scan, {names[0]}: {kind}{colors}", f"body: {body}"]


def _body_facts(outfit: Outfit) -> str:
    """An outfit's body in words."""
    vertices = outfit.template.vertices
    height = float(vertices[:, 1].max() - vertices[:, 1].min())
    joints = f"{len(outfit.body.parents)} joints" if outfit.body else "a mesh alone, which motions cannot pose"
    return f"{len(vertices):,} vertices, {height:.2f} m tall, {joints}"


def write_findings(path: Path, found: dict[str, Findings]) -> None:
    """Writes measures as CSV, a row a frame: its outfit, then the fields of `FrameFinding`."""
    names, rows = [entry.name for entry in fields(FrameFinding)], []
    for outfit, findings in found.items():
        for frame in findings.frames:
            values = [getattr(frame, name) for name in names]
            rows.append([outfit, *(" ".join(v) if isinstance(v, tuple) else v for v in values)])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, csv_text(["outfit", *names], rows).encode())
