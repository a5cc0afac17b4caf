"""Checks of a frame when it is loaded: units, overlap of scan and body, emptiness, so that bad data never trains."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from avatar.checks import DataError
from avatar.records import Frame, Template

BODY_HEIGHT = (0.5, 2.5)  # metres, at rest
SIZE_RATIO = (0.25, 2.5)  # posed body to body at rest, and scan to posed body: beyond it units differ
MOST_APART = 0.25  # metres between scan and body, median; a wide skirt stays below half of it
FEWEST_POINTS = 100
CHECKED_POINTS = 500


def check_template(template: Template, path: Path) -> None:
    """Refuses a body at rest that is no person's height in metres.

    Raises:
        DataError: with the factor that would mend centimetres or millimetres.
    """
    low, high = BODY_HEIGHT
    height = float(np.ptp(template.vertices.numpy()[:, 1]))
    if not low <= height <= high:
        problem = f"vertices: expected a body {low} to {high} m high, got {height:.4g} along y."
        raise DataError(path, problem, _unit_hint(height))


def check_frame(frame: Frame, template: Template, path: Path) -> None:
    """Refuses a frame whose body or scan is empty, in other units, or not where the other is.

    Raises:
        DataError: naming the file, what was expected and how to mend it.
    """
    points, body = frame.scan.points, frame.body.vertices
    if len(points) < FEWEST_POINTS:
        problem = f"scan: expected at least {FEWEST_POINTS} points, got {len(points)}."
        raise DataError(path, problem, "Leave the frame out or scan it again.")
    rest, posed, scan = (_diagonal(cloud) for cloud in (template.vertices.numpy(), body, points))
    low, high = SIZE_RATIO
    if not low <= posed / rest <= high:
        problem = f"body: expected about {rest:.2f} m across as at rest, got {posed:.4g}."
        raise DataError(path, problem, _unit_hint(posed))
    if not low <= scan / posed <= high:
        problem = f"scan: expected about {posed:.2f} m across as the body, got {scan:.4g}."
        raise DataError(path, problem, _unit_hint(scan))
    some = points[np.linspace(0, len(points) - 1, min(CHECKED_POINTS, len(points))).astype(int)]
    apart = float(np.median(cKDTree(body).query(some)[0]))
    if apart > MOST_APART:
        shift = np.median(body, axis=0) - np.median(points, axis=0)
        problem = f"scan: expected it over its body, half of its points are {apart:.2f} m and more away."
        mend = f"Both must stand in one frame; their middles differ by ({', '.join(f'{s:.2f}' for s in shift)}) m."
        raise DataError(path, problem, mend)
    lengths = np.linalg.norm(frame.scan.normals, axis=1)
    if (np.abs(lengths - 1) > 0.05).mean() > 0.01:
        problem = f"scan normals: expected unit length, got {lengths.min():.3g} to {lengths.max():.3g}."
        raise DataError(path, problem, "Normalise them, or compute them anew.")


def _diagonal(points: np.ndarray) -> float:
    """Length of a cloud's bounding-box diagonal."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _unit_hint(size: float) -> str:
    """What to do about a person of a wrong size."""
    for factor, unit in ((100, "centimetres"), (1000, "millimetres")):
        if BODY_HEIGHT[0] <= size / factor <= 2 * BODY_HEIGHT[1]:
            return f"That looks like {unit}: divide positions and translations by {factor}."
    return "Positions must be in metres with y up."
