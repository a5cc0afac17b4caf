"""Means, worst outfits and bootstrap intervals against closed forms and a known truth."""

import numpy as np
import pytest

from avatar.checks import AvatarError
from avatar.evaluation.aggregate import (
    Cell,
    Place,
    average_seeds,
    bootstrap_mean,
    frame_weighted_mean,
    order_methods,
    paired_differences,
    rows_of,
    worst_outfit,
)
from avatar.evaluation.scores import FrameScore, Score


def score(outfit, method, value, frames=10, seed=0, variant=""):
    return Score("t", outfit, method, variant, "cd_point", value, "m^2", frames, seed, 0, 0.0, 100, "c")


def frames_of(method, values, outfit="dress"):
    return [FrameScore(outfit, method, "", 0, f"a.{i:04d}", "cd_point", float(v)) for i, v in enumerate(values)]


def bootstrap_difference(frames, metric, first, second, **options):
    return bootstrap_mean(paired_differences(frames, metric, first, second).values(), **options)


def test_mean_counts_frames_and_max_counts_outfits():
    cells = [Cell(1.0, 30, 1), Cell(5.0, 10, 1)]
    assert frame_weighted_mean(cells) == pytest.approx(2.0)
    assert worst_outfit(cells) == 5.0
    assert worst_outfit(cells, higher_is_better=True) == 1.0


def test_seeds_are_averaged_and_variants_kept_apart():
    rows = [score("dress", "closet", 1.0, seed=0), score("dress", "closet", 3.0, seed=1)]
    rows.append(score("dress", "closet", 9.0, variant="learned"))
    found = {place: cell.value for place, cell in average_seeds(rows).items()}
    expected = {"closet": 2.0, "closet (learned)": 9.0}
    assert found == {Place(method, "dress", "cd_point"): value for method, value in expected.items()}


def test_two_rows_for_one_number_are_refused():
    with pytest.raises(AvatarError, match="two scores of cd_point for closet on dress"):
        average_seeds([score("dress", "closet", 1.0)] * 2)
    with pytest.raises(AvatarError, match="no score of cd_pop"):
        rows_of([score("dress", "closet", 1.0)], ["cd_pop"])


def test_floors_come_first():
    names = ["pop", "static (s1)", "closet", "body", "sampling (mesh)"]
    assert order_methods(names) == ["sampling (mesh)", "body", "static (s1)", "closet", "pop"]


def test_interval_holds_the_truth_about_as_often_as_it_says():
    random, held = np.random.default_rng(0), 0
    for trial in range(200):
        base = random.normal(size=40)
        frames = frames_of("a", base + 0.5 + random.normal(size=40)) + frames_of("b", base)
        interval = bootstrap_difference(frames, "cd_point", "a", "b", resamples=400, confidence=0.9, seed=trial)
        held += interval.low <= 0.5 <= interval.high
        assert interval.low < interval.difference < interval.high
    assert 0.83 <= held / 200 <= 0.95


def test_interval_is_paired_weighted_by_frames_and_repeats():
    frames = frames_of("a", [11, 12, 13, 99]) + frames_of("b", [10, 11, 12])  # the fourth frame has no pair
    frames += frames_of("a", [5], "shirt") + frames_of("b", [0], "shirt")
    interval = bootstrap_difference(frames, "cd_point", "a", "b")
    assert interval.frames == 4
    assert interval.difference == interval.low == interval.high == pytest.approx((3 * 1 + 5) / 4)
    noisy = frames_of("a", np.random.default_rng(0).normal(size=9)) + frames_of("b", np.zeros(9))
    first, same = (bootstrap_difference(noisy, "cd_point", "a", "b", seed=4) for _ in range(2))
    assert first == same != bootstrap_difference(noisy, "cd_point", "a", "b", seed=5)


def test_methods_without_common_frames_have_no_difference():
    assert paired_differences(frames_of("a", [1, 2]), "cd_point", "a", "c") == {}
