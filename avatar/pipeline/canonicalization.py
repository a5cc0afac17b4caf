"""`canonicalize`: posed raw scans to T-pose scans and a skinning field, with pictures of both and their scores."""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from avatar.canonical.fields import BodyField
from avatar.canonical.scans import canonicalize_scan
from avatar.checks import AvatarError
from avatar.data.batches import FrameDataset
from avatar.data.splits import spaced_frames
from avatar.environment import prepared_process
from avatar.evaluation.canonical import Canonicalized, canonical_table, check_truth, score_canonicalization
from avatar.evaluation.scores import Scores, write_scores
from avatar.evaluation.scoring import Label
from avatar.evaluation.tables import to_markdown
from avatar.export import pictures
from avatar.export.pictures import load_pyvista
from avatar.io.frames import read_canonical_scan
from avatar.io.ledger import Ledger, digest_of, module_digest
from avatar.io.locks import lock_folder
from avatar.io.npz import write_whole
from avatar.methods.canonicalizer import CanonicalizeConfig, SkinningSource, TrainedCanonicalizer, WeightSource
from avatar.pipeline.scores import current_commit
from avatar.progress import tracked
from avatar.records import Frame, Mesh, PointCloud
from avatar.runs.canonicalizing import canonicalize_frames, scans_digest, skinning_source, train_canonicalizer

COLUMNS = ("scan", "weights", "canonical, front", "canonical, back", "weights, front", "weights, back")
PICTURE = (480, 480)


@prepared_process()
def canonicalize(config: CanonicalizeConfig) -> Path:
    """Trains or resumes a run's canonicalizer, writes every frame's canonical scan, draws some; gives the folder.
    Refuses before any training: scores of data without truth, and pictures on a machine that cannot draw.
    """
    frames = config.frames()
    check_scored(config, frames)
    if config.pictures:
        load_pyvista()
    make_canonical_scans(config, frames)
    draw_canonical_scans(config, frames)
    return config.folder


def make_canonical_scans(config: CanonicalizeConfig, frames: FrameDataset) -> None:
    """Trains or resumes a run's canonicalizer, writes every frame's canonical scan and scores some, if asked for."""
    train_canonicalizer(config, frames)
    canonicalize_frames(config, frames)
    if config.scored:
        score_canonical_scans(config, frames)


def check_scored(config: CanonicalizeConfig, frames: FrameDataset) -> None:
    """Refuses to score scans of which nobody knows where they belong at rest."""
    try:
        if config.scored:
            check_truth(frames.frame(0).scan)
    except AvatarError as error:
        raise AvatarError(f"scored, {config.dataset}/{config.outfit}: {error} Hint: leave out scored.") from error


def score_canonical_scans(config: CanonicalizeConfig, frames: FrameDataset) -> Scores:
    """Writes ``<run>/scores.csv`` and ``scores.md``: this run, both baselines and the true weights on some frames.
    Variants are the splits: frames of training were learned from, those of test found their codes alone. What was
    measured before is measured again only where a scan, a canonicalizer or the code of either has changed.
    """
    outfit, scores, tables = frames.outfits[0], Scores(), []
    with lock_folder(config.folder, wait=True):
        ledger = Ledger(config.folder)
        for split in dict.fromkeys(where.split for where in frames.names):
            names = spaced_frames([where.name for where in frames.names if where.split == split], config.scored)
            methods, made_by = {}, {}
            for kind in dict.fromkeys((config.weights, WeightSource.knn, WeightSource.nearest)):
                settings = replace(config, weights=kind)
                source = skinning_source(settings, outfit.template)
                learned = (source.steps, source.seconds) if isinstance(source, TrainedCanonicalizer) else (0, 0.0)
                label = Label(kind.value, "canonical", split, 0, *learned, current_commit())
                methods[label] = canonicalizer_with(config, source)
                made_by[label] = digest_of([scans_digest(settings), module_digest(__name__)])
            found = score_canonicalization(outfit, split, names, methods, ledger, made_by)
            plain = [replace(row, variant="") for row in found.rows]
            tables.append(f"## {split}\n\n{to_markdown(canonical_table(plain, [outfit.name]))}")
            scores += found
        text = "\n".join(tables)
        write_scores(config.folder / "scores.csv", scores)
        write_whole(config.folder / "scores.md", text.encode())
    print(text)
    return scores


def canonicalizer_with(config: CanonicalizeConfig, source: SkinningSource) -> Callable[[Frame], Canonicalized]:
    """What a source of weights makes of a frame, with the weights that it gives to canonical points."""
    template = source.template
    field = source if isinstance(source, BodyField) else source.forward_field

    def unpose(frame: Frame) -> Canonicalized:
        weights = source.weights_of(frame.scan.points, frame)
        scan = canonicalize_scan(frame.scan, frame.body, weights, template, config.stretch)
        points = torch.from_numpy(scan.points)[None].to(next(field.buffers()).device)
        with torch.no_grad():
            return Canonicalized(scan, field(points)[0].cpu().numpy())

    return unpose


def draw_canonical_scans(config: CanonicalizeConfig, frames: FrameDataset) -> None:
    """Writes ``<run>/pictures/<split>.png``: some scans before and after, by their normals and skinning weights."""
    places = {(where.split, where.name): index for index, where in enumerate(frames.names)}
    for split in dict.fromkeys(where.split for where in frames.names) if config.pictures else ():
        chosen = spaced_frames([name for of, name in places if of == split], config.pictures)
        rows = [draw_frame(config, frames, places[split, name]) for name in tracked(chosen, "pictures", unit="picture")]
        sheet = pictures.contact_sheet(rows, chosen, COLUMNS)
        pictures.save_picture(config.folder / "pictures" / f"{split}.png", sheet)


def draw_frame(config: CanonicalizeConfig, frames: FrameDataset, index: int) -> list[np.ndarray]:
    """The row of pictures of one frame."""
    where, scan = frames.names[index], frames.frame(index).scan
    canonical = read_canonical_scan(config.folder / "scans" / where.split / f"{where.name}.npz")
    tints, grey = weight_colors(canonical.weights), np.full_like(scan.points, 0.6)
    grey[canonical.source] = tints
    posed, front = (pictures.frame_camera(of.points, size=PICTURE) for of in (scan, canonical))
    views = [(scan, posed, "normals"), (scan, posed, grey)]
    views += [(canonical, front.seen_from(side), by) for by in ("normals", tints) for side in ("front", "back")]
    return [
        pictures.render_points(PointCloud(of.points, of.normals), camera, colors)
        if of.faces is None
        else pictures.render_mesh(Mesh(of.points, of.faces), camera, colors)
        for of, camera, colors in views
    ]


def weight_colors(weights: np.ndarray) -> np.ndarray:
    """Skinning weights ``(M, J)`` as colours ``(M, 3)``: each joint has its own, neighbours in number far apart."""
    hues = (np.arange(weights.shape[1]) * 0.381966) % 1  # the golden section spreads them
    palette = np.array([colorsys.hsv_to_rgb(hue, 0.75, 0.95) for hue in hues])
    return np.clip(weights @ palette, 0, 1)
