"""Patterns: woven into the cloth, each garment its own, skin left alone."""

import numpy as np
import pytest

from avatar.checks import AvatarError
from avatar.data.layouts import OpenOutfit
from avatar.data.scanner import CHECK, PALETTES, SKIN, SPACING, STRIPE, Pattern, ScanConfig, paint, pattern_colors
from avatar.records import Scan

GROUND, FIGURE = PALETTES[0]


def colors_at(pattern, places, label=1):
    places = np.atleast_2d(np.asarray(places, float))
    return pattern_colors(pattern, places, np.full(len(places), label))


def test_stripes_are_level_and_checks_alternate():
    bands = colors_at(Pattern.stripes, [[x, (k + 0.5) * STRIPE, x] for x in (0, 0.3) for k in range(4)])
    np.testing.assert_allclose(bands, [GROUND, FIGURE] * 4, atol=1e-6)
    centre = np.array([0.5, 0.5, 0.5]) * CHECK
    steps = CHECK * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]])
    seen = colors_at(Pattern.checks, centre + steps)
    np.testing.assert_allclose(seen, [GROUND, FIGURE, FIGURE, FIGURE, GROUND, FIGURE], atol=1e-6)


def test_dots_and_flowers_stand_in_staggered_rows():
    for pattern in (Pattern.dots, Pattern.flowers):
        hearts = colors_at(pattern, SPACING * np.array([[0, 0, 0], [3, 1, 0], [0.5, 0.5, 0.5], [-0.5, 1.5, 0.5]]))
        assert np.ptp(hearts, axis=0).max() == 0
        assert np.abs(hearts[0] - GROUND).max() > 0.1
        between = colors_at(pattern, SPACING * np.array([[0.5, 0, 0.25], [0.25, 0.5, 0]]))
        np.testing.assert_allclose(between, [GROUND, GROUND], atol=1e-6)
    turn = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    ring = colors_at(Pattern.flowers, 0.024 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1))
    petal = (np.abs(ring - FIGURE) < 1e-6).all(axis=1)
    assert (petal != np.roll(petal, 1)).sum() == 8  # four petals: in and out of each


def test_every_garment_has_its_own_colours_and_skin_none():
    place = [[0.1, 0.5 * STRIPE, 0]]
    seen = [colors_at(Pattern.stripes, place, label)[0] for label in (0, 1, 2, 3, 4)]
    np.testing.assert_allclose(seen, [SKIN, *(ground for ground, _ in PALETTES), GROUND], atol=1e-6)
    assert seen[0].dtype == np.float32


def test_a_pattern_needs_the_truth_and_none_changes_nothing():
    bare = Scan(np.zeros((3, 3)), np.zeros((3, 3)))
    assert paint(bare, Pattern.none) is bare
    with pytest.raises(AvatarError, match="checks needs labels and canonical positions"):
        paint(bare, Pattern.checks)


def test_colours_stay_on_the_cloth_in_every_pose_and_sampling(tiny_folder):
    outfit = OpenOutfit(tiny_folder, "open", ScanConfig(points=1500, noise=0.002, holes=2, pattern=Pattern.checks))
    scans = [outfit.load("train", name).scan for name in ("rise.00000", "rise.00005")]
    scans += [outfit.resample("train", "rise.00001", 500, 1), outfit.load_mesh("train", "rise.00002")]
    for scan in scans:
        np.testing.assert_array_equal(scan.colors, pattern_colors(Pattern.checks, scan.canonical, scan.labels))
        assert len(np.unique(scan.colors, axis=0)) == 5  # skin and two garments of two colours
    assert OpenOutfit(tiny_folder, "open", ScanConfig(points=300)).load("train", "rise.00000").scan.colors is None
