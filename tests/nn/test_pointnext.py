"""PointNeXt's parts against loops over neighbourhoods."""

import torch
from spheres import TEMPLATE, sphere_template

from avatar.geometry.neighbours import ball_query
from avatar.nn.encoders import InvertedResidual, Neighbourhoods, PointNet2Config, PointNeXt
from avatar.nn.hierarchy import HierarchyConfig, build_levels

SIZES = HierarchyConfig(points=(40, 10), radii=(0.5, 1.5), neighbours=6)
WIDE = HierarchyConfig(points=(40, 10), radii=(0.5, 0.9), neighbours=40)  # all that a ball holds


def test_inverted_residual_equals_its_layers_applied_to_every_neighbour():
    torch.manual_seed(0)
    points, radius = build_levels(sphere_template().vertices, SIZES)[0].positions, 0.9
    groups = ball_query(points, points, radius, 6)
    block = InvertedResidual(Neighbourhoods(points, points, groups, radius), 5, 20).double().eval()
    features = torch.randn(2, len(points), 5, dtype=torch.float64)
    layer = block.aggregation
    weight = torch.cat([layer.feature_layer.weight, layer.position_layer.weight], dim=1)
    slow = []
    for centre, group in enumerate(groups):
        relative = ((points[group] - points[centre]).double() / radius).expand(2, -1, -1)
        assert relative.norm(dim=-1).max() <= 1 + 1e-6
        joined = torch.cat([features[:, group], relative], dim=-1)
        most = layer.first(joined @ weight.T + layer.feature_layer.bias).amax(dim=1)
        slow.append(torch.relu(features[:, centre] + block.mixing(most)))
    torch.testing.assert_close(block(features), torch.stack(slow, dim=1), rtol=1e-6, atol=1e-6)


def test_levels_see_positions_in_units_of_their_radius_and_blocks_twice_as_far():
    encoder = PointNeXt(TEMPLATE, 3, PointNet2Config(WIDE, ((16, 4), (32, 8)), ((8,), (4,))))
    levels = build_levels(TEMPLATE.vertices, WIDE)
    for stage, level, radius in zip(encoder.abstractions, levels, WIDE.radii):
        down, block = stage
        torch.testing.assert_close(down.level.positions * radius, level.positions)
        torch.testing.assert_close(down.level.finer_positions * radius, level.finer_positions)
        assert torch.equal(down.level.groups, level.groups)
        around = block.aggregation.level
        torch.testing.assert_close(around.positions * 2 * radius, level.positions)
        count, ranks = min(WIDE.neighbours, len(level.groups)), torch.arange(len(level.positions))
        expected = ball_query(level.positions, level.positions, 2 * radius, count, ranks)
        assert torch.equal(around.groups, expected)
        reach = (level.positions[around.groups] - level.positions[:, None]).norm(dim=-1)
        assert radius < reach.max() <= 2 * radius + 1e-6
    assert block.mixing[0].out_features == 32 and block.mixing[0].in_features == 8


def test_scaling_body_and_radii_together_changes_nothing():
    torch.manual_seed(0)
    config = PointNet2Config(SIZES, ((16, 4), (32, 8)), ((8,), (4,)))
    encoder = PointNeXt(TEMPLATE, 3, config).eval()
    scaled = sphere_template()
    double = HierarchyConfig(SIZES.points, tuple(2 * radius for radius in SIZES.radii), SIZES.neighbours)
    scaled = type(scaled)(**{**vars(scaled), "vertices": 2 * scaled.vertices})
    twin = PointNeXt(scaled, 3, PointNet2Config(double, config.abstraction, config.propagation)).eval()
    twin.load_state_dict(encoder.state_dict())
    features = torch.randn(1, 162, 3)
    torch.testing.assert_close(twin(features), encoder(features))
