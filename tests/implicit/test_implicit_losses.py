"""Every term against its equation on fields that are known; each is missed when it is dropped or turned about."""

from dataclasses import replace

import pytest
import torch

from avatar.checks import AvatarError
from avatar.implicit.losses import TERMS, FieldValues, ImplicitLossConfig, implicit_loss


def sphere_values(radius=0.5, off=0.0, slope=1.0, flip=1.0, colors=None):
    """The field slope (|x| - radius) + off asked at points on the unit-radius-scaled sphere and around it."""
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(2, 60, 3), dim=-1)
    space = torch.randn(2, 80, 3)
    uniform = 0.5 + 0.3 * torch.rand(2, 40)
    gradients = flip * slope * directions
    outward = flip * slope * torch.nn.functional.normalize(space, dim=-1)
    surface = torch.full((2, 60), off)
    boundary = torch.full((2, 30), flip * 0.4)
    return FieldValues(surface, gradients, outward, uniform - radius, boundary, colors), directions


def test_a_true_distance_loses_nothing_but_what_empty_space_costs():
    values, normals = sphere_values()
    raw = implicit_loss(values, normals, ImplicitLossConfig()).raw
    for name in ("surface", "normal", "eikonal", "box"):
        assert raw[name].item() == pytest.approx(0, abs=1e-6)
    assert raw["off_surface"].item() == pytest.approx(torch.exp(-100 * values.uniform.abs()).mean().item())


def test_each_term_is_its_equation():
    values, normals = sphere_values(off=-0.02, slope=1.5)
    raw = implicit_loss(values, normals, ImplicitLossConfig()).raw
    assert raw["surface"].item() == pytest.approx(0.02)  # |f|
    assert raw["normal"].item() == pytest.approx(0.5, rel=1e-5)  # ||1.5 n - n||, not squared
    assert raw["eikonal"].item() == pytest.approx(0.25, rel=1e-5)  # (1.5 - 1)^2, on surface and in space
    flipped, normals = sphere_values(flip=-1.0)
    raw = implicit_loss(flipped, normals, ImplicitLossConfig()).raw
    assert raw["normal"].item() == pytest.approx(2, rel=1e-5)
    assert raw["box"].item() == pytest.approx(0.4)
    assert raw["eikonal"].item() == pytest.approx(0, abs=1e-6)  # which way it runs is the normals' business


def test_the_eikonal_term_is_over_surface_and_space_alike():
    values, normals = sphere_values()
    doubled = FieldValues(
        values.surface, values.surface_gradients, 2 * values.space_gradients, values.uniform, values.boundary
    )
    raw = implicit_loss(doubled, normals, ImplicitLossConfig()).raw
    assert raw["eikonal"].item() == pytest.approx(80 / 140, rel=1e-5)


def test_off_surface_falls_with_distance_on_either_side():
    values, normals = sphere_values()
    near = replace(values, uniform=torch.tensor([[0.01, -0.01]] * 2))
    raw = implicit_loss(near, normals, ImplicitLossConfig(sharpness=50)).raw
    assert raw["off_surface"].item() == pytest.approx(torch.exp(torch.tensor(-0.5)).item())


def test_weights_count_and_a_weight_of_zero_drops_its_term():
    colors = torch.full((2, 60, 3), 0.25)
    values, normals = sphere_values(off=0.1, slope=1.2, flip=-1.0, colors=colors)
    truth = torch.full((2, 60, 3), 0.75)
    weights = {"surface": 2.0, "normal": 3.0, "eikonal": 4.0, "off_surface": 5.0, "box": 6.0, "color": 7.0}
    assert set(weights) == set(TERMS)
    terms = implicit_loss(values, normals, ImplicitLossConfig(**weights), truth)
    assert terms.raw["color"].item() == pytest.approx(0.5)
    for name, weight in weights.items():
        torch.testing.assert_close(terms.weighted[name], weight * terms.raw[name])
        without = implicit_loss(values, normals, ImplicitLossConfig(**(weights | {name: 0.0})), truth)
        assert name not in without.weighted and name in without.raw
        torch.testing.assert_close(without.total, terms.total - terms.weighted[name], rtol=1e-4, atol=1e-5)


def test_paper_weights_are_the_defaults():
    config = ImplicitLossConfig()
    assert [getattr(config, term) for term in TERMS] == [1, 1, 1, 0.1, 1, 1]
    assert config.sharpness == 100


def test_gradients_are_finite_where_slopes_vanish():
    gradients = torch.zeros(1, 4, 3, requires_grad=True)
    normals = torch.zeros(1, 4, 3)
    values = FieldValues(gradients.sum(-1), gradients, gradients, torch.zeros(1, 3), torch.zeros(1, 2))
    implicit_loss(values, normals, ImplicitLossConfig()).total.backward()
    assert torch.isfinite(gradients.grad).all()


def test_without_colours_there_is_no_such_term_and_bad_weights_are_refused():
    values, normals = sphere_values()
    assert "color" not in implicit_loss(values, normals, ImplicitLossConfig(), torch.zeros(2, 60, 3)).raw
    with pytest.raises(AvatarError, match="eikonal"):
        ImplicitLossConfig(eikonal=-1.0)
    with pytest.raises(AvatarError, match="normals"):
        implicit_loss(values, normals[:, :5], ImplicitLossConfig())
