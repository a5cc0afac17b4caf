"""The surface encoder against per-neighbour loops, parameter counts and invariances."""

from dataclasses import replace

import pytest
import torch
from reference import ball_loop
from spheres import sphere_template

from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.geometry.surface import farthest_points
from avatar.methods.closet import FULL_GARMENT_ENCODER, ClosetConfig
from avatar.nn import hierarchy
from avatar.nn.decoders import DecoderConfig, ShapeDecoder
from avatar.nn.encoders import FeaturePropagation, PointNet2, PointNet2Config, SetAbstraction
from avatar.nn.hierarchy import HierarchyConfig, build_levels

SIZES = HierarchyConfig(points=(40, 10), radii=(0.5, 1.5), neighbours=6)


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_full_encoders_and_decoders_have_the_published_sizes():
    template = open_body().template
    assert parameters(PointNet2(template, 3, PointNet2Config())) == 10_243_136
    assert parameters(PointNet2(template, 6, ClosetConfig().pose_encoder, relative=True)) == 10_244_096
    assert parameters(PointNet2(template, 64, PointNet2Config(**FULL_GARMENT_ENCODER))) == 280_928
    assert [parameters(ShapeDecoder(c, DecoderConfig())) for c in (67, 131, 132)] == [567_046, 599_814, 600_326]
    assert ClosetConfig().code_channels == 64


def test_levels_are_nested_and_interpolation_weights_follow_inverse_squares():
    points = sphere_template().vertices
    fine, coarse = build_levels(points, SIZES)
    assert torch.equal(coarse.finer_positions, fine.positions)
    for row in range(0, len(points), 17):
        distances = (points[row] - fine.positions).square().sum(dim=1)
        torch.testing.assert_close(distances[fine.up_ids[row]], distances.topk(3, largest=False).values)
        weights = 1 / (distances[fine.up_ids[row]] + 1e-8)
        torch.testing.assert_close(fine.up_weights[row], weights / weights.sum())
    assert (coarse.up_weights.sum(dim=1) - 1).abs().max() < 1e-6


def test_a_hierarchy_is_searched_once_and_every_call_has_its_own(monkeypatch):
    searched = []

    def search(points, count):
        searched.append(count)
        return farthest_points(points, count)

    monkeypatch.setattr(hierarchy, "farthest_points", search)
    monkeypatch.setattr(hierarchy, "BUILT", {})
    points = sphere_template().vertices
    first, second = build_levels(points, SIZES), build_levels(points.clone(), SIZES)
    before = {name: buffer.clone() for name, buffer in second.named_buffers()}
    for buffer in first.buffers():
        buffer.zero_()
    for levels in (second, build_levels(points, SIZES)):
        assert all(torch.equal(before[name], buffer) for name, buffer in levels.named_buffers())
    assert searched == [40]
    others = [(points * 2, SIZES), (points.double(), SIZES), (points, replace(SIZES, spread=False))]
    others += [(points, replace(SIZES, radii=(0.6, 1.5))), (points, replace(SIZES, neighbours=5))]
    for place, sizes in others:
        build_levels(place, sizes)
    assert len(searched) == 1 + len(others) and len(hierarchy.BUILT) == hierarchy.KEPT


def test_groups_are_the_balls_of_each_level_s_radius():
    """More neighbours are allowed than the balls hold, so that it is the radius that ends them."""
    points, sizes = sphere_template().vertices, HierarchyConfig((40, 10), (0.45, 1.3), 60)
    levels = build_levels(points, sizes)
    for level, radius in zip(levels, sizes.radii):
        slow = ball_loop(level.positions.numpy(), level.finer_positions.numpy(), radius, level.groups.shape[1])
        assert [set(group) for group in level.groups.tolist()] == [set(group) for group in slow]
        assert max(len(set(group)) for group in slow) < level.groups.shape[1]  # no ball is full


@pytest.mark.parametrize("differences", [False, True])
def test_set_abstraction_equals_the_layer_applied_to_every_neighbour(differences):
    torch.manual_seed(0)
    level = build_levels(sphere_template().vertices, SIZES)[0]
    layer = SetAbstraction(level, 5, (8, 7), relative=differences).double().eval()
    features = torch.randn(2, len(level.finer_positions), 5, dtype=torch.float64)
    weight = torch.cat([layer.feature_layer.weight, layer.position_layer.weight], dim=1)
    if differences:
        weight = torch.cat([weight, layer.difference_layer.weight], dim=1)
    slow = []
    for centre, group in enumerate(level.groups):
        relative = (level.finer_positions[group] - level.positions[centre]).expand(2, -1, -1)
        joined = torch.cat([features[:, group], relative], dim=-1)
        if differences:
            own = (level.finer_positions == level.positions[centre]).all(dim=1).nonzero().item()
            joined = torch.cat([joined, (features[:, group] - features[:, [own]]) / level.radius], dim=-1)
        slow.append(layer.rest(layer.first(joined @ weight.T + layer.feature_layer.bias)).amax(dim=1))
    torch.testing.assert_close(layer(features), torch.stack(slow, dim=1))


def test_the_first_abstraction_alone_is_relative_and_groups_may_be_the_nearest_points():
    encoder = PointNet2(sphere_template(), 3, PointNet2Config(SIZES, ((8,), (9,)), ((7,), (4,))), relative=True)
    assert [layer.difference_layer is not None for layer in encoder.abstractions] == [True, False]
    points = sphere_template().vertices
    nearest = build_levels(points, replace(SIZES, radii=(0.8, 1.5), spread=False))[0]
    reach, found = (  # on the sphere many points are equally near
        (points[groups] - nearest.positions[:, None]).norm(dim=-1)
        for groups in (torch.tensor(ball_loop(nearest.positions.numpy(), points.numpy(), 0.8, 6)), nearest.groups)
    )
    torch.testing.assert_close(found, reach)
    spread = build_levels(points, replace(SIZES, radii=(0.8, 1.5)))[0]
    assert torch.equal(spread.positions, nearest.positions) and not torch.equal(spread.groups, nearest.groups)


def test_groups_are_rows_of_the_finer_level():
    level = build_levels(sphere_template().vertices, SIZES)[0]
    values = torch.randn(2, 162, 5)
    assert torch.equal(level.group(values), values[:, level.groups])


def test_feature_propagation_equals_the_layers_on_interpolated_and_own_features():
    torch.manual_seed(0)
    level = build_levels(sphere_template().vertices.double(), SIZES)[0]
    layer = FeaturePropagation(level, 4, 2, (6, 5)).double().eval()  # in training a norm hides scale and bias
    coarse, fine = torch.randn(2, 40, 4).double(), torch.randn(2, 162, 2).double()
    spread = (coarse[:, level.up_ids] * level.up_weights[..., None]).sum(dim=2)
    torch.testing.assert_close(layer(coarse, fine), layer.mlp(torch.cat([spread, fine], dim=-1)))


def test_interpolation_returns_coarse_values_at_coarse_points():
    level = build_levels(sphere_template().vertices.double(), SIZES)[0]
    coarse = torch.randn(1, 40, 4, dtype=torch.float64)
    shared = (level.finer_positions[:, None] - level.positions[None]).norm(dim=-1).min(dim=0).indices
    torch.testing.assert_close(level.interpolate_up(coarse)[:, shared], coarse, rtol=1e-5, atol=1e-5)


def test_encoder_goes_down_and_up_with_each_level_s_own_features_joined():
    torch.manual_seed(0)
    encoder = PointNet2(sphere_template(), 3, PointNet2Config(SIZES, ((8,), (9,)), ((7,), (4,)))).eval()
    features = torch.randn(2, 162, 3)
    fine = encoder.abstractions[0](features)
    up = encoder.propagations[0](encoder.abstractions[1](fine), fine)
    torch.testing.assert_close(encoder(features), encoder.propagations[1](up, features))


def test_encoder_treats_frames_independently_and_sees_far_parts():
    torch.manual_seed(0)
    template = sphere_template()
    config = PointNet2Config(HierarchyConfig((40, 10), (0.5, 2.5), 40), ((8,), (8,)), ((8,), (4,)))
    encoder = PointNet2(template, 3, config).eval()
    features = torch.randn(3, 162, 3)
    together = encoder(features)
    torch.testing.assert_close(together[1:2], encoder(features[1:2]))
    moved = features.clone()
    moved[0, template.vertices[:, 1].argmax()] += 10
    assert (encoder(moved)[0] - together[0]).abs()[template.vertices[:, 1] < -0.5].max() > 0


def test_bad_sizes_are_refused():
    with pytest.raises(AvatarError, match="one radius a level"):
        HierarchyConfig(points=(4, 2), radii=(0.1,))
    with pytest.raises(AvatarError, match="falling sizes"):
        HierarchyConfig(points=(2, 4), radii=(0.1, 0.2))
    with pytest.raises(AvatarError, match="162 vertices"):
        build_levels(sphere_template().vertices, HierarchyConfig(points=(200, 4), radii=(0.1, 0.2)))
    with pytest.raises(AvatarError, match="one non-empty channel list"):
        PointNet2Config(SIZES, ((8,),), ((8,), (4,)))
