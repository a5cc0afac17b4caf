"""The sampling and body floors on spheres."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from avatar.checks import AvatarError
from avatar.evaluation.scoring import ScoreConfig, measure_floors, sample_body
from avatar.records import Mesh

CONFIG = ScoreConfig(metrics=["cd_point", "cd_pop", "s2m_cm", "jitter", "penetration_share"], motion=True)


def values(scores):
    return {row.metric: row.value for row in scores.rows}


def test_sampling_floor_shrinks_with_the_count(ball):
    """Squared spacing goes as 1 / count: four times the points, a quarter of the floor."""
    few, many = [], []
    for points, found in ((1500, few), (6000, many)):
        ball.points = points
        found.append(values(measure_floors(ball, "test", CONFIG, points).only("method", ["sampling"]))["cd_point"])
    assert few[0] / many[0] == pytest.approx(4, rel=0.1)


def test_sampling_floor_is_the_spacing_of_random_points(ball):
    """Mean squared distance to the nearest of N independent points on area A is A / (pi N)."""
    ball.points = 5000
    scores = measure_floors(ball, "test", CONFIG, 5000, commit="abc").only("method", ["sampling"])
    assert values(scores)["cd_point"] == pytest.approx(2 * 4 / 5000, rel=0.05)
    row = scores.rows[0]
    assert (row.method, row.variant, row.points, row.commit) == ("sampling", "", 5000, "abc")
    assert values(scores)["penetration_share"] == 0
    assert "jitter" not in values(scores)  # its points are drawn anew each frame


def test_scans_that_are_points_have_no_sampling_floor(ball_without_truth, caplog):
    with caplog.at_level(logging.WARNING):
        scores = measure_floors(ball_without_truth, "test", CONFIG, 3000)
    assert {row.method for row in scores.rows} == {"body"}
    assert (
        "ball: there is no sampling floor, and no excess over it: the scan of reach.0007 has no scan_faces"
        in caplog.text
    )


def test_scans_that_are_meshes_are_sampled_again(ball_without_truth):
    load = ball_without_truth.load

    def meshed(split, name):
        frame = load(split, name)
        faces = ConvexHull(frame.scan.points).simplices
        corners = frame.scan.points[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        inward = (normals * corners[:, 0]).sum(axis=1) < 0
        faces[inward] = faces[inward][:, ::-1]
        return replace(frame, scan=replace(frame.scan, faces=faces.astype(np.int64)))

    ball_without_truth.load = meshed
    scores = measure_floors(ball_without_truth, "test", CONFIG, 6000).only("method", ["sampling"])
    assert {(row.variant, row.points) for row in scores.rows} == {("mesh", 6000)}
    assert values(scores)["cd_point"] == pytest.approx(4 / 6000 + 4 / 3000, rel=0.1)


def test_a_sampling_that_is_not_independent_is_refused(ball):
    again = ball.resample
    ball.resample = lambda split, name, points, seed: again(split, name, points, 0)
    with pytest.raises(AvatarError, match="another sampling"):
        measure_floors(ball, "test", CONFIG, 3000).only("method", ["sampling"])


def test_body_floor_is_the_gap_between_body_and_cloth(ball):
    scores = measure_floors(ball, "test", CONFIG, 20_000).only("method", ["body"])
    assert values(scores)["s2m_cm"] == pytest.approx(10, abs=0.1)
    assert values(scores)["cd_pop"] == pytest.approx(2 * 0.1**2, rel=0.1)
    assert {(row.method, row.points) for row in scores.rows} == {("body", 20_000)}
    assert "jitter" not in values(scores)


def test_body_points_lie_on_the_body_with_its_normals(ball):
    cloud = sample_body(Mesh(ball.vertices, ball.template.faces), 4000, seed=0)
    radii = np.linalg.norm(cloud.points, axis=1)
    assert (radii <= 0.9 + 1e-6).all() and (radii > 0.9 * 0.995).all()
    np.testing.assert_allclose((cloud.normals * cloud.points).sum(axis=1) / radii, 1, atol=1e-3)
    assert (np.histogram(cloud.points[:, 1], bins=4, range=(-0.9, 0.9))[0] > 900).all()  # Archimedes: even in height
    again, other = (sample_body(Mesh(ball.vertices, ball.template.faces), 4000, seed=seed) for seed in (0, 1))
    assert (again.points == cloud.points).all() and (other.points != cloud.points).any()
