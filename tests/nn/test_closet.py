"""CloSET's network: its equations, its switches and its invariances, on a small body."""

import pytest
import torch
from spheres import DECODER, TEMPLATE, random_batch, small_config

from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate, sample_surface
from avatar.nn.closet import ClosetAvatar
from avatar.nn.methods import build_avatar, find_method
from avatar.records import Batch


def template_points(count: int = 200):
    return sample_surface(TEMPLATE.vertices, TEMPLATE.faces, count, torch.Generator().manual_seed(0))


def avatar(**switches) -> ClosetAvatar:
    torch.manual_seed(0)
    return ClosetAvatar(TEMPLATE, 2, small_config(**switches)).eval()


def test_points_are_the_transformed_offset_on_the_posed_body():
    batch, samples = random_batch(), template_points()
    prediction = avatar()(batch, samples)
    bodies = interpolate(batch.vertices, samples)
    linear = batch.vertex_transforms[:, 0, :3, :3]  # one transform a frame in this batch
    expected = bodies + prediction.offsets @ linear.transpose(1, 2)
    torch.testing.assert_close(prediction.points, expected)
    torch.testing.assert_close(prediction.normals.norm(dim=-1), torch.ones(3, 200))


def test_offset_is_garment_plus_wrinkle_and_scaled():
    batch, samples = random_batch(), template_points()
    model = avatar()
    prediction = model(batch, samples)
    torch.testing.assert_close(prediction.offsets, prediction.garment_offsets + prediction.wrinkle_offsets)
    model.config.offset_scale *= 2
    torch.testing.assert_close(model(batch, samples).offsets, 2 * prediction.offsets)


def test_template_is_one_for_all_poses_and_differs_by_outfit():
    batch, samples = random_batch(), template_points()
    model = avatar()
    prediction = model(batch, samples)
    torch.testing.assert_close(prediction.garment_offsets[0], prediction.garment_offsets[2])
    assert (prediction.garment_offsets[0] - prediction.garment_offsets[1]).abs().max() > 0
    assert (prediction.wrinkle_offsets[0] - prediction.wrinkle_offsets[2]).abs().max() > 0
    template = model.garment_template(0, samples)
    resting = interpolate(TEMPLATE.vertices, samples)
    torch.testing.assert_close(template.offsets[0], resting + prediction.garment_offsets[0])


def test_static_floor_ignores_the_pose_and_csf_has_no_template():
    batch, samples = random_batch(), template_points()
    static = avatar(pose=False)
    prediction = static(batch, samples)
    assert prediction.wrinkle_offsets is None
    torch.testing.assert_close(prediction.offsets[0], prediction.offsets[2])
    csf = avatar(template=False)
    prediction = csf(batch, samples)
    assert prediction.garment_offsets is None
    torch.testing.assert_close(prediction.offsets, prediction.wrinkle_offsets)
    with pytest.raises(AvatarError, match="without an explicit garment template"):
        csf.garment_template(0, samples)
    with pytest.raises(AvatarError, match="at least one branch"):
        small_config(template=False, pose=False)


def test_garment_branch_runs_once_an_outfit(monkeypatch):
    model, seen = avatar(), []
    forward = model.garment_encoder.forward
    monkeypatch.setattr(model.garment_encoder, "forward", lambda codes: seen.append(len(codes)) or forward(codes))
    model(random_batch(), template_points())
    assert seen == [2]


def test_point_count_is_free_and_points_are_independent():
    batch, many = random_batch(), template_points(400)
    model = avatar()
    few = type(many)(many.vertex_ids[::4], many.barycentric[::4], many.face_ids[::4])
    torch.testing.assert_close(model(batch, few).points, model(batch, many).points[:, ::4], rtol=1e-5, atol=1e-5)


def test_frames_do_not_see_each_other():
    batch, samples = random_batch(), template_points()
    model = avatar()
    alone = Batch(**{k: v[:1] for k, v in vars(batch).items()})
    torch.testing.assert_close(model(alone, samples).points, model(batch, samples).points[:1], rtol=1e-5, atol=1e-5)


def test_pose_noise_acts_in_training_only():
    batch, samples = random_batch(), template_points()
    quiet, noisy = avatar(), avatar(pose_noise=0.1)
    torch.testing.assert_close(noisy(batch, samples).points, quiet(batch, samples).points)
    torch.manual_seed(0)
    first = noisy.train()(batch, samples).points
    assert (first - noisy(batch, samples).points).abs().max() > 1e-6


def test_every_parameter_gets_a_gradient():
    model = avatar().train()
    prediction = model(random_batch(), template_points())
    (prediction.points.square().sum() + prediction.normals[..., 0].sum()).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.isfinite().all()] == []


def test_registry_names_its_methods():
    with pytest.raises(AvatarError, match="closet"):
        find_method("clsoet")
    with pytest.raises(AvatarError, match="ClosetConfig"):
        build_avatar("closet", TEMPLATE, 1, DECODER)
    assert isinstance(build_avatar("closet", TEMPLATE, 1, small_config()), ClosetAvatar)


def test_without_offsets_the_prediction_is_the_bare_body_with_its_normals():
    batch, samples = random_batch(), template_points()
    model = avatar()
    for decoder in (model.garment_decoder, model.pose_decoder):
        for branch in (decoder.offset_branch, decoder.normal_branch):
            torch.nn.init.zeros_(branch[-1].weight)
            torch.nn.init.zeros_(branch[-1].bias)
    prediction = model(batch, samples)
    torch.testing.assert_close(prediction.points, interpolate(batch.vertices, samples))
    skin = interpolate(TEMPLATE.vertices, samples)  # a sphere's normals point as its points do
    expected = torch.nn.functional.normalize(skin @ batch.vertex_transforms[:, 0, :3, :3].transpose(1, 2), dim=-1)
    assert ((prediction.normals * expected).sum(dim=-1) > 0.98).all()
