"""The floors every comparison stands on: a second sampling of the true surface, and the bare body."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from avatar.checks import AvatarError
from avatar.data.outfits import Outfit
from avatar.evaluation.metrics import Comparison
from avatar.evaluation.scores import Scores
from avatar.evaluation.scoring import (
    Label,
    ScoreConfig,
    draw_scan,
    frame_generator,
    frame_names,
    pick_points,
    posed_body,
    remember_scores,
    score_frames,
)
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.io.ledger import Ledger
from avatar.records import Frame, Mesh, PointCloud

log = logging.getLogger(__name__)


def score_sampling_floor(
    outfit: Outfit, split: str, config: ScoreConfig, points: int, commit: str = "", ledger: Ledger | None = None
) -> Scores:
    """Scores a second sampling of the true surface as if it were a prediction: what a perfect surface scores.

    An outfit without ``resample`` has only its scan points: they are split into halves, scored against each other
    and marked as variant ``halves``; with fewer points that floor is too high.

    Args:
        points: points of the second sampling; take as many as the methods predict.
        ledger: where values are kept, as for predictions.
    """
    resample = getattr(outfit, "resample", None)

    def compare(frame: Frame) -> Comparison:
        scan = draw_scan(frame, config)
        if resample is None:
            order = frame_generator(frame.name, config.seed + 1).permutation(len(scan.points))
            again, scan = (pick_points(scan, np.sort(half)) for half in np.array_split(order, 2))
        else:
            again = resample(split, frame.name, points, seed=config.seed + 1)
            if (again.points[:10, None] == frame.scan.points).all(axis=2).any(axis=1).all():
                raise AvatarError("resample: expected another sampling of the surface, got the scan's own points.")
        return Comparison(PointCloud(again.points, again.normals), scan, posed_body(outfit, frame))

    if resample is None:
        log.warning("%s: no true surface to sample again, so the sampling floor compares scan halves.", outfit.name)
    label = Label("sampling", variant="halves" if resample is None else "", commit=commit, split=split)
    return _score_floor(outfit, split, config, points, label, compare, ledger)


def score_body_floor(
    outfit: Outfit, split: str, config: ScoreConfig, points: int, commit: str = "", ledger: Ledger | None = None
) -> Scores:
    """Scores points spread area-uniformly over the posed bare body as if they were a prediction: no clothes at all."""

    def compare(frame: Frame) -> Comparison:
        body = posed_body(outfit, frame)
        if body is None:
            raise AvatarError("template: the body floor needs the body's faces, and this outfit has no template.")
        return Comparison(sample_body(body, points, config.seed), draw_scan(frame, config), body)

    return _score_floor(outfit, split, config, points, Label("body", commit=commit, split=split), compare, ledger)


def _score_floor(
    outfit: Outfit,
    split: str,
    config: ScoreConfig,
    points: int,
    label: Label,
    compare: Callable[[Frame], Comparison],
    ledger: Ledger | None,
) -> Scores:
    """Scores a floor's frames, each for itself: its points do not follow each other."""
    names, config = frame_names(outfit, split), replace(config, motion=False)
    memory = remember_scores(ledger, label.method, outfit, split, config, points=points)
    return score_frames(outfit, split, names, config, label, compare, memory)


def sample_body(body: Mesh, points: int, seed: int) -> PointCloud:
    """Points spread area-uniformly over a mesh, with interpolated vertex normals."""
    vertices = torch.from_numpy(np.asarray(body.vertices, np.float64))
    faces = torch.from_numpy(np.asarray(body.faces, np.int64))
    samples = sample_surface(vertices, faces, points, torch.Generator().manual_seed(seed))
    normals = torch.nn.functional.normalize(interpolate(vertex_normals(vertices, faces), samples), dim=-1)
    return PointCloud(interpolate(vertices, samples).numpy(), normals.numpy())
