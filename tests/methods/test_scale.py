"""SCALE's network: its frames and patches in closed form, its equation against a loop, its two kinds of feature."""

from dataclasses import replace

import pytest
import torch
from cut_sphere import ATLASED
from spheres import DECODER, TEMPLATE, random_batch

from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate, sample_surface
from avatar.methods.registry import find_method
from avatar.methods.scale import PointNet, PointNetConfig, PoseFeature, ScaleAvatar, ScaleConfig
from avatar.nn.unet import UNetConfig
from avatar.records import SurfaceSamples, Template

BATCH = replace(random_batch(), outfit_ids=torch.zeros(3, dtype=torch.long))


def avatar(template: Template = ATLASED, **switches) -> ScaleAvatar:
    torch.manual_seed(0)
    options = {"map_size": 16, "patches": 60} | switches
    config = ScaleConfig(UNetConfig(3, 4, 6, True), PointNetConfig((8, 8), (8,)), DECODER, **options)
    return ScaleAvatar(template, 1, config).eval()


def square() -> Template:
    """A unit square in two triangles, which fills its atlas."""
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return replace(TEMPLATE, vertices=corners, faces=faces, weights=torch.ones(4, 1), uv=corners[:, :2], uv_faces=faces)


def test_paper_has_798_patches_of_16_or_64_points():
    model = avatar(square(), map_size=32, patches=798)
    assert len(model.patch_rows) == len(model.patch_rows.unique()) == 798
    assert [len(model.template_samples(points).face_ids) for points in (12_768, 51_072)] == [12_768, 51_072]
    assert len(avatar(square(), map_size=8, patches=798).patch_rows) == 64


def test_patches_are_spread_over_the_body():
    """A third of the pixels, and yet none is far from a patch."""
    model = avatar()
    centres = interpolate(ATLASED.vertices, model.patches)
    everywhere = interpolate(ATLASED.vertices, model.atlas.grid.samples)
    assert len(centres) == 60 and len(everywhere) > 85
    assert torch.cdist(everywhere, centres).min(dim=1).values.max() < torch.cdist(centres, centres).max() / 5


def test_points_of_a_patch_are_a_regular_grid_over_its_pixel():
    model = avatar()
    samples = model.template_samples(60 * 9)
    uv = model.atlas.place(samples).view(60, 9, 2) * 16
    torch.testing.assert_close(uv.mean(dim=1), model.patch_corners + 0.5, rtol=0, atol=1e-3)
    own = (uv - model.patch_corners[:, None]).mean(dim=0)
    expected = torch.tensor([[x, y] for y in (1, 3, 5) for x in (1, 3, 5)]) / 6
    torch.testing.assert_close(own, expected, rtol=0, atol=1e-3)
    assert samples.barycentric.min() < 0  # cells beyond the triangle, in its plane
    torch.testing.assert_close(samples.barycentric.sum(dim=1), torch.ones(540), rtol=0, atol=1e-4)


def test_frame_is_two_edges_and_a_normal_as_long_as_edges_are():
    model = avatar(square(), map_size=8, patches=64)
    posed = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0]]])
    frames = model.patch_frames(posed)
    lower = model.patches.face_ids == 0
    mean = ((3 + 5) * lower.sum() + (5 + 4) * (~lower).sum()) / 2 / 64
    expected = torch.stack([torch.tensor([3.0, 0, 0]), torch.tensor([3.0, 4, 0]), torch.tensor([0, 0, mean])], dim=-1)
    torch.testing.assert_close(frames[0, lower], expected.expand(int(lower.sum()), -1, -1))
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q
    turn = turn * turn.det().sign()
    torch.testing.assert_close(model.patch_frames(posed @ turn.T + 2), turn @ frames, rtol=1e-4, atol=1e-4)
    both = model.patch_frames(torch.cat([posed, 2 * posed]))  # a mean over each body's own edges
    torch.testing.assert_close(both, torch.cat([frames, 2 * frames]))


@pytest.mark.parametrize("pose_feature", list(PoseFeature))
def test_points_agree_with_a_loop_over_them(pose_feature):
    model = avatar(pose_feature=pose_feature)
    samples = model.template_samples(60 * 4)
    prediction = model(BATCH, samples)
    centres, frames = interpolate(BATCH.vertices, model.patches), model.patch_frames(BATCH.vertices)
    features = model.pose_features(BATCH.pose_vertices)
    cells = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    for patch in (0, 17, 59):
        for cell in range(4):
            uv = (model.patch_corners[patch] + 0.5) / 16
            decoded = model.decoder(features[1:2, patch : patch + 1], torch.cat([uv, cells[cell]])[None])
            shift = frames[1, patch] @ decoded.offsets[0, 0]
            found = 4 * patch + cell
            torch.testing.assert_close(prediction.points[1, found], centres[1, patch] + shift, rtol=1e-3, atol=1e-4)
            torch.testing.assert_close(prediction.offsets[1, found], shift, rtol=1e-3, atol=1e-4)
            normal = frames[1, patch] @ (decoded.normals[0, 0] + torch.tensor([0.0, 0.0, 1.0]))
            torch.testing.assert_close(prediction.normals[1, found], normal / normal.norm(), rtol=1e-3, atol=1e-3)


def test_pose_is_told_by_the_pose_vertices_alone():
    model = avatar()
    samples = model.template_samples(60)
    offsets = model(BATCH, samples).offsets
    away = replace(BATCH, vertices=BATCH.vertices + 1)
    torch.testing.assert_close(model(away, samples).offsets, offsets, rtol=1e-4, atol=1e-5)
    bent = replace(BATCH, pose_vertices=BATCH.pose_vertices.flip(0))
    assert (model(bent, samples).offsets - offsets).abs().amax(dim=(1, 2))[[0, 2]].min() > 1e-4


def test_without_offsets_points_are_where_patches_ride_on_the_posed_body():
    model = avatar()
    for value in model.decoder.offset_branch[-1].parameters():
        torch.nn.init.zeros_(value)
    points = model(BATCH, model.template_samples(60 * 4)).points
    centres = interpolate(BATCH.vertices, model.patches)
    torch.testing.assert_close(points, centres.repeat_interleave(4, dim=1))


def test_local_features_differ_between_patches_and_global_ones_do_not():
    local = avatar().pose_features(BATCH.pose_vertices)
    whole = avatar(pose_feature=PoseFeature.whole).pose_features(BATCH.pose_vertices)
    assert local.shape == whole.shape == (3, 60, 6)
    assert (local - local[:, :1]).abs().max() > 0
    assert torch.equal(whole, whole[:, :1].expand_as(whole))
    assert (whole[0] - whole[2]).abs().max() > 0


def test_local_feature_is_the_patches_own_pixel():
    model = avatar()
    image = model.pose_encoder(model.atlas.position_map(BATCH.pose_vertices))
    column, row = model.patch_corners[31].tolist()
    torch.testing.assert_close(model.pose_features(BATCH.pose_vertices)[:, 31], image[:, :, row, column])


def test_pointnet_does_not_know_the_order_of_points():
    torch.manual_seed(0)
    net, cloud = PointNet(5, PointNetConfig((8, 16), ())).eval(), torch.randn(2, 30, 3)
    torch.testing.assert_close(net(cloud[:, torch.randperm(30)]), net(cloud))
    torch.testing.assert_close(net(cloud[:, torch.arange(30).repeat(2)[:45]]), net(cloud))  # a maximum, no mean
    assert net.train()(cloud[:1]).shape == (1, 5)


def test_any_point_of_the_body_belongs_to_a_patch_near_it():
    model = avatar()
    for value in model.decoder.offset_branch[-1].parameters():
        torch.nn.init.zeros_(value)
    samples = sample_surface(ATLASED.vertices, ATLASED.faces, 300, torch.Generator().manual_seed(0))
    gaps = (model(BATCH, samples).points - interpolate(BATCH.vertices, samples)).norm(dim=-1)
    assert gaps.max() < 0.9 and gaps.mean() < 0.25  # patches of a unit sphere are about half a unit wide


def test_the_far_corner_of_the_atlas_belongs_to_its_last_patch():
    model = avatar(square(), map_size=8, patches=64)
    corner = SurfaceSamples(model.atlas.faces[:1], torch.tensor([[0.0, 0, 1]]), torch.tensor([0]))
    assert model.atlas.place(corner).tolist() == [[1, 1]]
    vertices = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0]]])
    batch = replace(BATCH, pose_vertices=vertices, vertices=vertices)
    prediction = model(batch, corner)
    riding = interpolate(vertices, model.patches)[0, model.patch_of_pixel[63]]
    torch.testing.assert_close(prediction.points[0, 0] - prediction.offsets[0, 0], riding)
    torch.testing.assert_close(riding, torch.tensor([3.0, 4, 0]) * 7.5 / 8)


def test_points_do_not_depend_on_what_else_is_asked_for():
    model = avatar()
    samples = model.template_samples(60 * 4)
    part = SurfaceSamples(*(value[100:131] for value in vars(samples).values()))
    torch.testing.assert_close(
        model(BATCH, part).points, model(BATCH, samples).points[:, 100:131], rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("pose_feature", list(PoseFeature))
def test_every_parameter_gets_a_gradient(pose_feature):
    model = avatar(pose_feature=pose_feature).train()
    prediction = model(BATCH, model.template_samples(240))
    (prediction.points.square().sum() + prediction.normals[..., 0].sum()).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.isfinite().all()] == []


def test_bad_uses_are_refused():
    with pytest.raises(AvatarError, match="one outfit, got 2"):
        find_method("scale").network(ATLASED, 2, ScaleConfig())
    with pytest.raises(AvatarError, match="UV coordinates"):
        find_method("scale").network(TEMPLATE, 1, ScaleConfig())
    with pytest.raises(AvatarError, match="multiple of 32"):
        ScaleConfig(map_size=48)
    with pytest.raises(AvatarError, match="patches"):
        ScaleConfig(patches=0)
    with pytest.raises(AvatarError, match="positive channel counts"):
        PointNetConfig(points=())
