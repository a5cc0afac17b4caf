"""Runs on a simulated outfit: learning beats the static floor, folders come back as avatars, errors are clear."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from tiny import SETTINGS, quick_training

from avatar.checks import AvatarError, DataError
from avatar.data.splits import SplitConfig
from avatar.io.points import read_points
from avatar.simulate.sequences import authored_motion
from avatar.training.prediction import body_batch, predict, predict_frames, predict_motion, template_samples
from avatar.training.runs import MethodChoice, RunConfig, choose_device, load_run, train_run


@pytest.fixture(scope="module")
def settings(tiny_folder, tmp_path_factory) -> RunConfig:
    train = quick_training(steps=260, points=3000, scan_points=3000, validate_every=130, save_every=130)
    return RunConfig(
        method=MethodChoice("closet", "closet", SETTINGS),
        dataset=tiny_folder.parent.name,
        outfit=(tiny_folder.name,),
        data_root=tiny_folder.parents[1],
        runs_root=tmp_path_factory.mktemp("runs"),
        split=SplitConfig(validation_share=0.2),
        train=train,
    )


@pytest.fixture(scope="module")
def trained(settings):
    torch.manual_seed(0)
    return train_run(settings)


def distance(points: np.ndarray, scan: np.ndarray) -> float:
    return float((cKDTree(scan).query(points)[0] ** 2).mean() + (cKDTree(points).query(scan)[0] ** 2).mean())


def held_out_error(folder, outfit) -> float:
    avatar, samples = load_run(folder), None
    errors = []
    for name in outfit.frames("test"):
        frame = outfit.load("test", name)
        samples = template_samples(avatar, 8000)
        cloud = predict(avatar.model, body_batch([frame.body], 0, (name,)), samples)
        floor = distance(outfit.resample("test", name, 8000, 1).points, frame.scan.points)
        errors.append(distance(cloud.points, frame.scan.points) - floor)
    return float(np.mean(errors))


@pytest.mark.slow
def test_learning_beats_the_static_floor_on_unseen_poses(settings, trained, tiny_outfit):
    static = replace(settings, method=MethodChoice("closet", "static", SETTINGS | {"pose": False}))
    moving, still = held_out_error(trained, tiny_outfit), held_out_error(train_run(static), tiny_outfit)
    assert moving < 0.85 * still


@pytest.mark.slow
def test_a_run_comes_back_as_it_was_trained(settings, trained, tiny_outfit, tmp_path):
    avatar = load_run(trained)
    assert avatar.steps == settings.train.steps
    assert not avatar.model.training
    paths = predict_frames(avatar, tiny_outfit, "test", tmp_path / "a", 2000)
    assert [path.stem for path in paths] == list(tiny_outfit.frames("test"))
    again = predict_frames(load_run(trained), tiny_outfit, "test", tmp_path / "b", 2000)
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(paths, again))
    assert read_points(paths[0]).points.shape == (2000, 3)
    best = load_run(trained, "best")
    assert best.steps in (130, 260)
    motion = authored_motion("walk", fps=10, seconds=0.5)
    posed = predict_motion(avatar, tiny_outfit, motion, tmp_path / "m", 1000)
    assert len(posed) == len(motion.poses)
    assert np.ptp(read_points(posed[0]).points[:, 1]) > 1.2


@pytest.mark.slow
def test_going_on_with_other_settings_is_refused(settings, trained):
    with pytest.raises(AvatarError, match=r"train\.lr.*another name"):
        train_run(replace(settings, train=replace(settings.train, lr=1.0)))
    assert train_run(settings) == trained  # finished: nothing left to do, nothing lost


@pytest.mark.slow
def test_damaged_and_unfinished_runs_are_refused(trained, tmp_path):
    with pytest.raises(DataError, match=r"avatar\.safetensors.*no such file.*tools/train\.py"):
        load_run(tmp_path)
    copy = tmp_path / "run"
    copy.mkdir()
    for name in ("avatar.safetensors", "avatar.json", "template.npz"):
        (copy / name).write_bytes((trained / name).read_bytes())
    assert load_run(copy).steps == 260
    with pytest.raises(DataError, match="no best checkpoint"):
        load_run(copy, "best")
    (copy / "avatar.safetensors").write_bytes(b"x" * 100)
    with pytest.raises(DataError, match="sha256"):
        load_run(copy)


def test_point_counts_and_outfits_out_of_range_are_refused(settings, tiny_outfit):
    with pytest.raises(AvatarError, match="1,000 to 400,000"):
        template_samples(tiny_outfit.template, 10)
    with pytest.raises(AvatarError, match="400,000"):
        template_samples(tiny_outfit.template, 400_001)
    with pytest.raises(DataError, match=r"no such outfit.*Did you mean 'tiny'"):
        train_run(replace(settings, outfit=("tinny",)))
    with pytest.raises(AvatarError, match="different outfits"):
        replace(settings, outfit=("tiny", "tiny"))
    with pytest.raises(AvatarError, match="device: expected auto, cpu"):
        choose_device("warpdrive")
