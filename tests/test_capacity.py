"""The model can represent what it sees: one scan, learned by heart, comes back to the distance of two samplings."""

import pytest
import torch
from runs.test_runs import distance
from tiny import SETTINGS, quick_training

from avatar.data.batches import FrameDataset, FrameName
from avatar.data.layouts import find_outfit
from avatar.geometry.surface import sample_surface
from avatar.methods.closet import ClosetAvatar, ClosetConfig
from avatar.methods.losses import LossConfig
from avatar.methods.points import PointTask, body_batch, predict
from avatar.settings import settings_from_dict
from avatar.training.trainer import Trainer

POINTS = 12_000


@pytest.mark.slow
@pytest.mark.parametrize("outfit", ["tee"])
def test_one_frame_is_learned_to_within_half_of_the_sampling_distance(tmp_path, outfit):
    data = find_outfit(tmp_path, "sample", outfit)
    name = data.frames("train")[0]
    frame = data.load("train", name)
    frames = FrameDataset([data], [FrameName(0, "train", name)], 8000)
    loss = LossConfig(offset=1, normal_start=0.3)
    config = quick_training(
        steps=350, batch=1, points=8000, scan_points=8000, lr=4e-3, validate_every=1000, save_every=1000, loss=loss
    )
    torch.manual_seed(0)
    model = ClosetAvatar(data.template, 1, settings_from_dict(ClosetConfig, SETTINGS))
    Trainer(PointTask(model, data.template, config, lambda step: frames.batch_at(step, 1), 1), config, tmp_path).fit()
    generator = torch.Generator().manual_seed(1)
    samples = sample_surface(data.template.vertices, data.template.faces, POINTS, generator)
    cloud = predict(model.eval(), body_batch([frame.body], 0, (name,)), samples)
    scan = data.resample("train", name, POINTS, seed=7).points
    floor = distance(data.resample("train", name, POINTS, seed=8).points, scan)
    assert distance(cloud.points, scan) < 1.5 * floor
