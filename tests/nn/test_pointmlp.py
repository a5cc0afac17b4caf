"""PointMLP's parts against loops over neighbourhoods, and what every encoder behind the switch must keep."""

from pathlib import Path

import pytest
import torch
import yaml
from spheres import TEMPLATE, sphere_template

from avatar.methods.closet import FULL_GARMENT_ENCODER
from avatar.nn.encoders import (
    ENCODERS,
    Encoder,
    GeometricAffine,
    PointMLP,
    PointMLPLevel,
    PointNet2Config,
    ResidualPointMLP,
)
from avatar.nn.hierarchy import HierarchyConfig, build_levels

CONF = Path(__file__).parents[2] / "conf"
SIZES = HierarchyConfig(points=(40, 10), radii=(0.5, 1.5), neighbours=6)
SMALL = PointNet2Config(SIZES, ((5, 8), (6, 12)), ((8,), (4,)))


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def preset(kind: str, size: str, part: str) -> PointNet2Config:
    """The channels that ``size`` gives an encoder, on levels small enough for the sphere."""
    base = {"pose_encoder": {}, "garment_encoder": FULL_GARMENT_ENCODER}
    if size == "small":
        base = yaml.safe_load((CONF / "method_size/closet_small.yaml").read_text())
    path = CONF / f"encoder/{kind}_{size}.yaml"
    changes = yaml.safe_load(path.read_text()) if path.is_file() else {part: {}}
    levels = HierarchyConfig((60, 40, 20, 10, 8, 6), (0.3, 0.5, 0.8, 1.0, 2.0, 3.0), 4)
    return PointNet2Config(**{**base[part], **changes[part], "hierarchy": levels})


@pytest.mark.parametrize("size", ["full", "small"])
@pytest.mark.parametrize(("part", "channels"), [("pose_encoder", 3), ("garment_encoder", {"full": 64, "small": 16})])
@pytest.mark.parametrize("kind", ["pointmlp", "pointnext"])
def test_presets_have_about_as_many_parameters_as_pointnet2(kind, size, part, channels):
    channels = channels if isinstance(channels, int) else channels[size]
    ours = parameters(ENCODERS[Encoder(kind)](TEMPLATE, channels, preset(kind, size, part)))
    theirs = parameters(ENCODERS[Encoder.pointnet2](TEMPLATE, channels, preset("pointnet2", size, part)))
    assert abs(ours / theirs - 1) < 0.07


def test_affine_brings_a_cloud_to_unit_differences_whatever_its_scale():
    torch.manual_seed(0)
    affine = GeometricAffine(4).double()
    grouped, centres = torch.randn(2, 5, 3, 4, dtype=torch.float64), torch.randn(2, 5, 4, dtype=torch.float64)
    found = affine(grouped, centres)
    for cloud in range(2):
        differences = torch.stack([grouped[cloud, i] - centres[cloud, i] for i in range(5)])
        sigma = (differences.square().sum() / (5 * 3 * 4)).sqrt()
        torch.testing.assert_close(found[cloud], differences / (sigma + 1e-5))
    torch.testing.assert_close(affine(7 * grouped, 7 * centres), found, rtol=1e-4, atol=1e-4)
    torch.nn.init.constant_(affine.alpha, 3.0)
    torch.nn.init.constant_(affine.beta, 2.0)
    torch.testing.assert_close(affine(grouped, centres), 3 * found + 2)


def test_affine_of_identical_neighbours_has_finite_gradients():
    affine = GeometricAffine(4)
    grouped = torch.ones(1, 5, 3, 4, requires_grad=True)
    affine(grouped, torch.ones(1, 5, 4)).sum().backward()
    assert torch.isfinite(grouped.grad).all()


def test_level_equals_its_layers_applied_to_every_neighbourhood():
    torch.manual_seed(0)
    level = build_levels(sphere_template().vertices, SIZES)[0]
    stage = PointMLPLevel(level, 5, (6, 8)).double().eval()
    features = torch.randn(2, len(level.finer_positions), 5, dtype=torch.float64)
    joined = torch.cat([features, level.finer_positions.double().expand(2, -1, -1)], dim=-1)
    own = [int((level.finer_positions - centre).norm(dim=-1).argmin()) for centre in level.positions]
    differences = torch.stack([joined[:, group] - joined[:, i, None] for i, group in zip(own, level.groups)], dim=1)
    sigma = differences.square().mean(dim=(1, 2, 3)).sqrt()[:, None, None, None] + 1e-5
    weight = torch.cat([stage.difference_layer.weight, stage.centre_layer.weight], dim=1)
    slow = []
    for row, i in enumerate(own):
        scaled = stage.affine.alpha * differences[:, row] / sigma[:, 0] + stage.affine.beta
        both = torch.cat([scaled, joined[:, i, None].expand_as(scaled)], dim=-1)
        lifted = torch.relu(stage.norm(both @ weight.T + stage.centre_layer.bias))
        slow.append(stage.after(stage.before(lifted).amax(dim=1)))
    torch.testing.assert_close(stage(features), torch.stack(slow, dim=1))


def test_residual_block_adds_to_what_came_in():
    block = ResidualPointMLP(6, 3).eval()
    torch.nn.init.zeros_(block.layers[-1].weight)
    features = torch.randn(2, 5, 6)
    torch.testing.assert_close(block(features), features.relu())


@pytest.mark.parametrize("kind", list(Encoder))
def test_every_encoder_keeps_the_same_contract(kind):
    torch.manual_seed(0)
    levels = HierarchyConfig((40, 10), (0.5, 2.5), 40)
    config = PointNet2Config(levels, ((5, 8), (6, 12)), ((8,), (4,)))
    encoder = ENCODERS[kind](TEMPLATE, 3, config)
    assert type(encoder) is ENCODERS[kind]
    assert (encoder.channels, encoder.out_channels) == (3, 4)
    features = torch.randn(3, 162, 3, requires_grad=True)
    encoder(features).square().sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())
    assert features.grad.abs().sum(dim=(0, 2)).min() > 0
    encoder.eval()
    together = encoder(features)
    assert together.shape == (3, 162, 4)
    torch.testing.assert_close(together[1:2], encoder(features[1:2]))  # frames do not see each other
    moved = features.detach().clone()
    moved[0, TEMPLATE.vertices[:, 1].argmax()] += 10
    assert (encoder(moved)[0] - together[0]).abs()[TEMPLATE.vertices[:, 1] < -0.5].max() > 0  # far parts do
    again = ENCODERS[kind](TEMPLATE, 3, config)
    again.load_state_dict(encoder.state_dict())
    torch.testing.assert_close(again.eval()(features), together)


def test_pointmlp_is_what_the_switch_gives():
    assert isinstance(ENCODERS[Encoder.pointmlp](TEMPLATE, 3, SMALL), PointMLP)
