"""Units and up axes of scans: found from how people stand and from their bodies, refused where two would do."""

from pathlib import Path

import numpy as np
import pytest

from avatar.body.open import open_body
from avatar.body.solving import posed_vertices
from avatar.checks import DataError
from avatar.data.layouts import find_outfit
from avatar.data.scanner import ScanConfig
from avatar.geometry.units import METRES
from avatar.sources.placement import TURNS, FittedSample, StandingBody, find_placement, robust_height

PATH = Path("scans")


@pytest.fixture(scope="module")
def sample():
    """Scans of the dress, their bodies, and what is known of the body."""
    outfit = find_outfit(Path("data"), "sample", "dress", ScanConfig(points=3000))
    frames = [outfit.load("train", name) for name in outfit.frames("train")[:18:3]]
    weights = outfit.template.weights.numpy()
    low, high = (weights[:, joints].sum(axis=1) for joints in ([7, 8], [16, 17]))
    body = StandingBody(outfit.template.faces.numpy(), low / low.sum(), high / high.sum())
    return [frame.scan.points for frame in frames], [frame.body.vertices for frame in frames], body


def stored(points: np.ndarray, unit: str, up: str) -> np.ndarray:
    return points @ TURNS[up] / METRES[unit]


def fits(bodies: list[np.ndarray], unit: str, up: str) -> list[FittedSample]:
    return [FittedSample(np.zeros_like(body), stored(body, unit, up)) for body in bodies]


def test_turns_are_rotations_that_bring_their_axis_up():
    for up, turn in TURNS.items():
        axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
        np.testing.assert_array_equal(turn @ axis, [0, 1, 0])
        assert np.linalg.det(turn) == 1


@pytest.mark.parametrize(("unit", "up"), [("m", "y"), ("cm", "z"), ("mm", "z")])
def test_scans_alone(sample, unit, up):
    scans, _, _ = sample
    placement = find_placement(PATH, [stored(scan, unit, up) for scan in scans], "auto", "auto")
    assert placement.decided == {"units": unit, "up": up}
    np.testing.assert_allclose(placement.scan(stored(scans[0], unit, up)), scans[0], atol=1e-6)


@pytest.mark.parametrize(("unit", "up"), [("m", "y"), ("cm", "z"), ("mm", "-y"), ("in", "x")])
@pytest.mark.parametrize(("fit_unit", "fit_up"), [("m", "y"), ("mm", "z")])
def test_scans_over_fitted_bodies(sample, unit, up, fit_unit, fit_up):
    """Whatever each is stored in, both come out in one frame, upright."""
    scans, bodies, body = sample
    given = [stored(scan, unit, up) for scan in scans[:2]]
    placement = find_placement(PATH, given, "auto", "auto", fits(bodies[:2], fit_unit, fit_up), body)
    assert placement.decided == {"units": unit, "up": up, "fit units": fit_unit, "fit up": fit_up}
    np.testing.assert_allclose(placement.scan(given[0]), scans[0], atol=1e-6)
    np.testing.assert_allclose(placement.fit(stored(bodies[0], fit_unit, fit_up)), bodies[0], atol=1e-6)


def test_what_is_given_is_taken(sample, caplog):
    scans, bodies, body = sample
    placement = find_placement(PATH, scans, "cm", "z")
    assert placement.decided == {"units": "cm", "up": "z"}
    find_placement(PATH, scans[:2], "auto", "z", fits(bodies[:2], "m", "y"), body)
    assert "up=z as it was given, but bodies stand along y" in caplog.text


@pytest.mark.parametrize(
    ("height", "message"),
    [(12.0, "a height of 12 .* in no unit"), (68.0, r"a height of 68 is 1\.73 m in in and 0\.68 m in cm")],
    ids=["no-unit", "two-units"],
)
def test_heights_are_refused(sample, height, message):
    scans = [scan * height / robust_height(scan) for scan in sample[0]]
    with pytest.raises(DataError, match=message):
        find_placement(PATH, scans, "auto", "y")


def test_two_axes_are_refused_with_both_figures():
    ball = np.random.default_rng(0).standard_normal((2000, 3))
    with pytest.raises(DataError, match=r"standing figures lie 0\.\d+ m with . up and 0\.\d+ m with . up from 1 scans"):
        find_placement(PATH, [1.7 * ball / robust_height(ball)], "auto", "auto")


def test_scans_that_are_not_over_their_bodies(sample):
    scans, bodies, body = sample
    with pytest.raises(DataError, match=r"expected scans over their fitted bodies, got \d+% of the body"):
        find_placement(PATH, [scan + [1, 0, 0] for scan in scans[:2]], "auto", "auto", fits(bodies[:2], "m", "y"), body)


def test_people_who_lie(sample):
    scans, bodies, body = sample
    half = np.linalg.qr(np.array([[1.0, 1, 1], [1, -1, 0], [1, 1, -2]]).T)[0]
    with pytest.raises(DataError, match="expected bodies upright along an axis"):
        mixed = [np.eye(3), TURNS["-y"]]
        turned = [body @ turn @ half for body, turn in zip(bodies, mixed)]
        scans = [scan @ turn @ half for scan, turn in zip(scans, mixed)]
        find_placement(PATH, scans, "auto", "auto", [FittedSample(0 * body, body) for body in turned], body)


def test_turned_parameters_pose_the_turned_body(sample):
    body, placement = open_body("female"), find_placement(PATH, sample[0][:1], "cm", "z")
    rng = np.random.default_rng(0)
    pose, translation = 0.3 * rng.standard_normal((22, 3)), 100 * rng.standard_normal(3)
    pelvis = body.zero_joints[0].double().numpy()
    turned = posed_vertices(body, *placement.pose(pose, translation, pelvis))
    expected = posed_vertices(body, pose, 0.01 * translation) @ TURNS["z"].T
    np.testing.assert_allclose(turned, expected, atol=1e-5)
