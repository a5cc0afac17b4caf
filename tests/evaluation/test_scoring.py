"""Scoring of folders: values, means, errors that name frames, and what is drawn from scans."""

import logging
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from avatar.checks import AvatarError, DataError
from avatar.evaluation.metrics import find_metrics
from avatar.evaluation.scoring import Contender, Label, Memory, ScoreConfig, draw_scan, score_frames, score_predictions
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.records import Mesh, PointCloud

FAST = ["cd_point", "s2m_cm"]


@pytest.fixture
def predictions(tmp_path, ball, sphere_cloud):
    """Spheres a little too large: 10, 20, 30 and 40 mm."""
    for place, name in enumerate(ball.names):
        points, normals = sphere_cloud(2500, 1.01 + 0.01 * place, 99)
        write_points(tmp_path / f"{name}.ply", PointCloud(points, normals))
    return tmp_path


def value(scores, metric):
    (row,) = [row for row in scores.rows if row.metric == metric]
    return row.value


def test_means_and_single_frames(ball, predictions):
    label = Label("closet", "main", "small", 3, 400, 12.5, "abc")
    scores = score_predictions(predictions, ball, "test", ScoreConfig(metrics=FAST), label)
    assert [row.metric for row in scores.rows] == FAST
    row = scores.rows[1]
    assert (row.table, row.outfit, row.method, row.variant, row.commit) == ("main", "ball", "closet", "small", "abc")
    assert (row.unit, row.frames, row.seed, row.steps, row.seconds, row.points) == ("cm", 4, 3, 400, 12.5, 2500)
    frames = {f.frame: f.value for f in scores.frames if f.metric == "s2m_cm"}
    assert [frames[name] for name in sorted(frames)] == pytest.approx([4, 1, 2, 3], abs=0.15)  # reach.0007 first
    assert row.value == pytest.approx(np.mean(list(frames.values())))


def test_scoring_twice_gives_the_same_bits(ball, predictions):
    config = ScoreConfig(scan_points=500, metrics=FAST)
    first, again = (score_predictions(predictions, ball, "test", config, Label("closet")) for _ in range(2))
    assert first == again


def test_missing_frames_are_named(ball, predictions):
    (predictions / "walk.0001.ply").unlink()
    with pytest.raises(DataError, match=r"1 of 4 frames have no prediction.*walk\.0001"):
        score_predictions(predictions, ball, "test", ScoreConfig(metrics=FAST), Label("closet"))
    with pytest.raises(DataError, match="no such folder"):
        score_predictions(predictions / "none", ball, "test", ScoreConfig(metrics=FAST), Label("closet"))


def test_extra_files_are_ignored_with_a_warning(ball, predictions, caplog):
    expected = score_predictions(predictions, ball, "test", ScoreConfig(metrics=FAST), Label("closet"))
    (predictions / "stray.0001.ply").write_bytes(b"nonsense")
    with caplog.at_level(logging.WARNING):
        assert score_predictions(predictions, ball, "test", ScoreConfig(metrics=FAST), Label("closet")) == expected
    assert "stray.0001.ply" in caplog.text


def test_nan_prediction_names_the_file(ball, predictions):
    path = predictions / "walk.0002.ply"
    data = bytearray(path.read_bytes())
    data[-24:-20] = np.float32(np.nan).tobytes()
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"walk\.0002\.ply.*NaN"):
        score_predictions(predictions, ball, "test", ScoreConfig(metrics=FAST), Label("closet"))


def test_centimetres_are_refused(ball, predictions, sphere_cloud):
    points, normals = sphere_cloud(500, 100.0, 0)
    write_points(predictions / "walk.0002.ply", PointCloud(points, normals))
    with pytest.raises(DataError, match=r"walk\.0002\.ply.*times its size.*metres"):
        score_predictions(predictions, ball, "test", ScoreConfig(metrics=FAST), Label("closet"))


def test_error_in_a_metric_names_the_frame(ball, predictions, sphere_cloud):
    points, normals = sphere_cloud(4, 1.0, 0)
    write_points(predictions / "walk.0000.ply", PointCloud(points, normals))
    with pytest.raises(AvatarError, match=r"ball, closet, frame walk\.0000.*more than 5 points"):
        score_predictions(predictions, ball, "test", ScoreConfig(metrics=["uniformity"]), Label("closet"))


def test_a_value_that_is_not_finite_is_seen_in_the_mean_and_left_out_where_values_are_partial(ball):
    metric = replace(find_metrics(["cd_point"])[0], measure=lambda seen: seen.value)
    memory = Memory(None, "closet", ball, "test")

    def compare(frame):
        return SimpleNamespace(value=math.inf if frame.name == "walk.0001" else 1.0, points=frame.scan.points)

    def score(partial):
        contenders = [Contender(Label("closet"), compare, memory)]
        (row,) = score_frames(ball, "test", ball.names, [metric], contenders, partial=partial).rows
        return row.value, row.frames

    assert score(partial=False) == (math.inf, 4) and score(partial=True) == (1.0, 3)


def test_unknown_metric_and_bad_counts_are_refused_at_once():
    with pytest.raises(AvatarError, match=r"chamfer.*cd_point"):
        ScoreConfig(metrics=["chamfer"])
    with pytest.raises(AvatarError, match="scan_points"):
        ScoreConfig(scan_points=0)


def test_meshes_take_the_place_of_points_in_surface_metrics(ball, predictions, tmp_path):
    faces, scale = ball.template.faces, 1.05 / 0.9
    for name in ball.names:
        write_mesh(tmp_path / "meshes" / f"{name}.obj", Mesh(ball.vertices * scale, faces))
    config = ScoreConfig(metrics=[*FAST, "self_intersection"])
    scores = score_predictions(predictions, ball, "test", config, Label("closet"), meshes=tmp_path / "meshes")
    assert value(scores, "s2m_cm") == pytest.approx(5, abs=0.15)
    assert value(scores, "self_intersection") == 0
    plain = score_predictions(predictions, ball, "test", config, Label("closet"))
    assert value(scores, "cd_point") == value(plain, "cd_point")
    assert "self_intersection" not in {row.metric for row in plain.rows}  # points have no faces


def test_penetration_through_the_folder(ball, predictions, sphere_cloud):
    for name in ball.names:
        points, normals = sphere_cloud(1000, 0.95, 0)
        points[:100] *= 0.85 / 0.95
        write_points(predictions / f"{name}.ply", PointCloud(points, normals))
    config = ScoreConfig(metrics=["penetration_share", "penetration_depth"])
    scores = score_predictions(predictions, ball, "test", config, Label("closet"))
    assert value(scores, "penetration_share") == pytest.approx(0.1)
    assert value(scores, "penetration_depth") == pytest.approx(0.05, abs=2e-3)


def test_jitter_only_over_consecutive_frames_and_only_when_asked(ball, predictions, sphere_cloud):
    points, normals = sphere_cloud(300, 1.0, 0)
    for name in ball.names:
        number = int(name[-4:])
        lifted = points + np.float32([0, 0.05 * number**2, 0])  # acceleration 0.1 m a frame^2
        write_points(predictions / f"{name}.ply", PointCloud(lifted, normals))
    config = ScoreConfig(metrics=["cd_point", "jitter"], motion=True)
    scores = score_predictions(predictions, ball, "test", config, Label("closet"))
    assert value(scores, "jitter") == pytest.approx(0.1, rel=1e-4)
    assert [f.frame for f in scores.frames if f.metric == "jitter"] == ["walk.0002"]
    ball.names = ("walk.0000", "walk.0001", "reach.0007")  # no three frames in a row
    gaps = score_predictions(predictions, ball, "test", config, Label("closet"))
    assert [row.metric for row in gaps.rows] == ["cd_point"]
    config.motion = False
    still = score_predictions(predictions, ball, "test", config, Label("closet"))
    assert [row.metric for row in still.rows] == ["cd_point"]


def test_frames_far_apart_are_no_motion(ball, predictions):
    ball.names = ("walk.0000", "walk.0001", "walk.0003")
    (predictions / "walk.0002.ply").rename(predictions / "walk.0003.ply")
    config = ScoreConfig(metrics=["jitter"], motion=True)
    assert score_predictions(predictions, ball, "test", config, Label("closet")).rows == []


def test_jitter_refuses_point_counts_that_change(ball, predictions, sphere_cloud):
    points, normals = sphere_cloud(100, 1.0, 0)
    write_points(predictions / "walk.0001.ply", PointCloud(points, normals))
    config = ScoreConfig(metrics=["jitter"], motion=True)
    with pytest.raises(AvatarError, match=r"walk\.0002.*one point count"):
        score_predictions(predictions, ball, "test", config, Label("closet"))


def test_scan_points_are_a_subset_drawn_by_name_and_seed(ball):
    frame, other = ball.load("test", "walk.0000"), ball.load("test", "walk.0001")
    drawn = draw_scan(frame, ScoreConfig(scan_points=100))
    whole = {tuple(p): tuple(n) for p, n in zip(frame.scan.points, frame.scan.normals)}
    assert len({tuple(p) for p in drawn.points}) == 100
    assert all(whole[tuple(p)] == tuple(n) for p, n in zip(drawn.points, drawn.normals))
    assert (draw_scan(frame, ScoreConfig(scan_points=100)).points == drawn.points).all()
    assert (draw_scan(frame, ScoreConfig(scan_points=100, seed=1)).points != drawn.points).any()
    assert len(draw_scan(other, ScoreConfig(scan_points=99_999)).points) == ball.points
    twin = replace(frame, name=other.name)
    assert (draw_scan(twin, ScoreConfig(scan_points=100)).points != drawn.points).any()
