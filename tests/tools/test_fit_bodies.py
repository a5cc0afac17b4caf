"""Errors of fitted bodies: none for the true body, and tables that keep what other runs measured."""

import numpy as np
import pytest

from avatar.body.families import fixed_family
from avatar.checks import AvatarError
from avatar.evaluation.scores import read_scores
from avatar.fitting.settings import FittingConfig, StageConfig
from benchmarks import fitting
from benchmarks.fitting import FitBodiesConfig, body_errors, fit_bodies, hide_body

QUICK = FittingConfig(headings=1, stages=[StageConfig(points=200, steps=4, reach=0.3, cloth=0.3, sigma=0.05)])


def test_the_true_body_has_no_error(tiny_outfit):
    name = tiny_outfit.frames("test")[0]
    frame, hidden = tiny_outfit.load("test", name), hide_body(tiny_outfit, name, FitBodiesConfig(turned=False))
    errors = body_errors(tiny_outfit.body, frame.body.pose, frame.body.translation, hidden)
    assert max(errors.values()) < 0.01  # mm


def test_turned_scans_keep_their_bodies(tiny_outfit):
    name = tiny_outfit.frames("test")[0]
    still, turned = (hide_body(tiny_outfit, name, FitBodiesConfig(turned=way)) for way in (False, True))
    assert np.abs(still.cloud.points - turned.cloud.points).max() > 0.1
    for one, other in ((still.vertices, turned.vertices), (still.joints, turned.joints)):
        np.testing.assert_allclose(one[:, 1] - still.joints[0, 1], other[:, 1] - turned.joints[0, 1], atol=1e-5)
        gaps = [
            np.linalg.norm(ends[:20, None] - body.cloud.points[None, :20], axis=-1)
            for ends, body in ((one, still), (other, turned))
        ]
        np.testing.assert_allclose(*gaps, atol=1e-5)


def test_outfits_are_measured_into_one_table(tiny_folder, tiny_outfit, tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "anny_family", lambda: fixed_family(tiny_outfit.body))
    places = {"data": tiny_folder.parents[1], "dataset": "open", "outfits": ["tiny"], "out": tmp_path, "frames": 1}
    for turned in (False, True):
        path = fit_bodies(FitBodiesConfig(**places, turned=turned, fitting=QUICK))
    scores = read_scores(tmp_path / "fitting.csv")
    assert {row.variant for row in scores.rows} == {"raw_as_scanned", "raw_turned"}
    assert (
        {row.metric for row in scores.rows}
        == set(fitting.UNITS)
        == {*(f.metric for f in scores.frames), *fitting.CLOCKS}
    )
    assert path.read_text().count("| open | tiny |") == 2
    assert (tmp_path / "fitting" / "open_tiny_raw_turned" / "quality.csv").is_file()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"scanner": "rough"}, "scanner: expected .*perfect"),
        ({"split": "tests"}, "split: "),
        ({"outfits": []}, "outfits: expected at least one"),
        ({"frames": 0}, "frames: expected at least 1, got 0"),
        ({"table": "../x"}, "table: expected a plain name"),
    ],
)
def test_wrong_settings_are_refused(option, message):
    with pytest.raises(AvatarError, match=message):
        FitBodiesConfig(**option)
