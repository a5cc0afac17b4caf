"""Skinning fields: the published sizes, weights that are weights, boxes, codes and gradients."""

import pytest
import torch

from avatar.canonical.fields import (
    SkinningField,
    SkinningFieldConfig,
    bounding_box,
    normalise,
)
from avatar.checks import AvatarError
from avatar.geometry.transforms import fourier_features

BOX = torch.tensor([[-1.0, -2, -3], [1, 2, 3]])


def field(joints: int = 5, seed: int = 0, **options) -> SkinningField:
    torch.manual_seed(seed)
    return SkinningField(joints, SkinningFieldConfig(**({"width": 16} | options)), BOX)


@pytest.mark.parametrize(
    ("orders", "latent", "parameters"), [(4, 0, 151_832), (6, 0, 157_976), (4, 64, 184_600), (8, 64, 196_888)]
)
def test_sizes_are_the_published_ones(orders, latent, parameters):
    network = SkinningField(24, SkinningFieldConfig(orders=orders, latent=latent), BOX)
    assert sum(parameter.numel() for parameter in network.parameters()) == parameters


@pytest.mark.parametrize("joints", [1, 3, 55])
def test_weights_are_positive_and_sum_to_one_inside_and_outside_the_box(joints):
    weights = field(joints)(100 * torch.randn(2, 50, 3))
    assert weights.shape == (2, 50, joints)
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(dim=-1), torch.ones(2, 50))


def test_features_are_the_points_and_sines_of_doubling_frequency():
    point = torch.tensor([0.3, -0.5, 0.9])
    features = fourier_features(point, 3)
    expected = [point, *(wave(factor * point) for factor in (1, 2, 4) for wave in (torch.sin, torch.cos))]
    torch.testing.assert_close(features, torch.cat(expected))


def test_a_box_is_stretched_to_the_unit_cube_and_the_answer_goes_with_it():
    corners = normalise(BOX[None], BOX)
    torch.testing.assert_close(corners[0], torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    network, points = field(), torch.rand(2, 30, 3)
    moved = torch.stack([BOX + 7, 2 * BOX])
    there = torch.stack([points[0] + 7, 2 * points[1]])
    torch.testing.assert_close(network(there, box=moved), network(points), atol=1e-5, rtol=1e-4)


def test_bounding_box_has_room_in_proportion_to_its_longest_side():
    points = torch.tensor([[0.0, 0, 0], [2, 1, 0]])
    torch.testing.assert_close(bounding_box(points, 0.1), torch.tensor([[-0.2, -0.2, -0.2], [2.2, 1.2, 0.2]]))
    with pytest.raises(AvatarError, match="finite"):
        bounding_box(torch.full((3, 3), torch.nan))


def test_codes_tell_frames_apart_and_one_of_them_folds_into_biases():
    network = field(latent=4)
    points, codes = torch.randn(2, 40, 3), torch.randn(2, 4)
    weights = network(points, codes)
    assert not torch.allclose(weights[0], network(points[:1], codes[1:])[0])
    bare = network.with_latent(codes[1])
    assert bare.config.latent == 0
    torch.testing.assert_close(bare(points[1:]), weights[1:], atol=1e-6, rtol=1e-5)
    with pytest.raises(AvatarError, match="latent"):
        network(points)


def test_the_features_come_back_at_the_skip_layer():
    network = field()
    points = torch.randn(1, 20, 3)
    before = network(points)
    with torch.no_grad():
        network.layers[2].weight[:, 16:] += 1  # columns of the features alone
    assert (network(points) - before).abs().max() > 1e-3


def test_gradients_in_points_are_right():
    network = field(orders=3).double()
    points = torch.rand(1, 4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(network, (points,))


@pytest.mark.parametrize("options", [{"skip": 0}, {"skip": 3}, {"layers": 1}, {"width": 0}, {"orders": -1}])
def test_impossible_sizes_are_refused(options):
    with pytest.raises(AvatarError, match=next(iter(options))):
        SkinningFieldConfig(**options)
