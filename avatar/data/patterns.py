"""Procedural colours for simulated garments: woven patterns that stay on the cloth however it is posed.

A colour follows from a point's place on the garment at rest and from which garment it is, so it is the same in
every frame, in points and in meshes alike.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum

import numpy as np

from avatar.checks import AvatarError, check_shape
from avatar.records import Scan

SKIN = (0.80, 0.60, 0.49)
PALETTES = (  # ground and figure of the first garment, the second, ...
    ((0.93, 0.89, 0.80), (0.72, 0.16, 0.20)),
    ((0.16, 0.24, 0.42), (0.85, 0.72, 0.38)),
    ((0.24, 0.42, 0.36), (0.93, 0.91, 0.84)),
)
HEART = (0.95, 0.74, 0.18)  # of a flower
STRIPE = 0.035  # metres, width of a stripe
CHECK = 0.05  # metres, side of a check
SPACING = 0.10  # metres between rows of dots and flowers
DOT, FLOWER, FLOWER_HEART = 0.022, 0.042, 0.011  # metres, radii


class Pattern(Enum):
    """What a garment is woven with."""

    none = "none"
    stripes = "stripes"  # level bands
    checks = "checks"
    dots = "dots"
    flowers = "flowers"  # four petals around a heart


def paint(scan: Scan, pattern: Pattern) -> Scan:
    """The scan with colours; as it is for `Pattern.none`.

    Raises:
        AvatarError: for a scan without labels and canonical positions, which only simulated data has.
    """
    if pattern is Pattern.none:
        return scan
    if scan.canonical is None or scan.labels is None:
        raise AvatarError(f"pattern: {pattern.value} needs labels and canonical positions, the scan has none.")
    return replace(scan, colors=pattern_colors(pattern, scan.canonical, scan.labels))


def pattern_colors(pattern: Pattern, canonical: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Colours of points on skin and garments.

    Args:
        pattern: of all garments; each has its own two colours. Skin (label 0) has none.
        canonical: ``(M, 3)`` places on the garments at rest, metres.
        labels: ``(M,)`` which garment, 0 is skin.

    Returns:
        ``(M, 3)`` float32 RGB in [0, 1].
    """
    dims = check_shape("canonical", canonical, "M 3")
    check_shape("labels", labels, "M", **dims)
    garment = (np.asarray(labels, np.int64) - 1) % len(PALETTES)
    palettes = np.array(PALETTES)[garment]
    ground, figure = palettes[:, 0], palettes[:, 1]
    colors = np.where(_on_figure(pattern, canonical)[:, None], figure, ground)
    if pattern is Pattern.flowers:
        hearts = np.linalg.norm(_from_lattice(canonical), axis=1) < FLOWER_HEART
        colors[hearts] = HEART
    colors[np.asarray(labels) == 0] = SKIN
    return colors.astype(np.float32)


def _on_figure(pattern: Pattern, canonical: np.ndarray) -> np.ndarray:
    """Which points ``(M,)`` have the figure's colour."""
    if pattern is Pattern.none:
        return np.zeros(len(canonical), bool)
    if pattern is Pattern.stripes:
        return np.floor(canonical[:, 1] / STRIPE) % 2 == 1
    if pattern is Pattern.checks:
        return np.floor(canonical / CHECK).sum(axis=1) % 2 == 1
    away = _from_lattice(canonical)
    distance = np.linalg.norm(away, axis=1)
    if pattern is Pattern.dots:
        return distance < DOT
    # petals along the axes: whichever way the cloth cuts through, it shows four of them
    petals = np.abs(away).max(axis=1) / np.maximum(distance, 1e-9)
    return distance < FLOWER * petals**4


def _from_lattice(points: np.ndarray) -> np.ndarray:
    """From the nearest centre of a body-centred lattice to each point, ``(M, 3)``: staggered rows on all sides."""
    first = points - SPACING * np.rint(points / SPACING)
    shifted = points - SPACING / 2
    second = shifted - SPACING * np.rint(shifted / SPACING)
    nearer = np.linalg.norm(first, axis=1) < np.linalg.norm(second, axis=1)
    return np.where(nearer[:, None], first, second)
