"""A field on a lattice, and the body's weights as a field."""

import numpy as np
import pytest
import torch

from avatar.body.open import open_body
from avatar.canonical.fields import BodyField
from avatar.checks import AvatarError
from avatar.implicit.networks import FieldLattice

BOX = torch.tensor([[-0.5, 0.0, -0.2], [0.5, 0.73, 0.3]])


def trilinear(points):
    """A function that trilinear interpolation gives exactly."""
    x, y, z = points.unbind(dim=-1)
    return torch.stack([2 * x - y + 3 * z + 1, x * y * z - z * x], dim=-1)


def test_what_is_linear_between_nodes_is_exact_with_its_slope():
    torch.manual_seed(0)
    lattice = FieldLattice(lambda p: 2 * p + 1, BOX.double(), 0.11)
    points = BOX[0] + (BOX[1] - BOX[0]) * torch.rand(2, 200, 3, dtype=torch.float64)
    points.requires_grad_()
    torch.testing.assert_close(lattice(points), 2 * points + 1)  # up to the last node, beyond the box's far side
    torch.testing.assert_close(torch.autograd.grad(lattice(points).sum(), points)[0], torch.full_like(points, 2))


def test_nodes_are_met_and_middles_of_cells_are_the_mean_of_their_corners():
    spacing = 0.1
    lattice = FieldLattice(trilinear, BOX.double(), spacing)
    node = BOX[0].double() + spacing * torch.tensor([3.0, 2.0, 1.0])
    torch.testing.assert_close(lattice(node[None, None]), trilinear(node[None, None]))
    offsets = spacing * torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3).double()
    middle = (node + spacing / 2)[None, None]
    torch.testing.assert_close(lattice(middle)[0, 0], trilinear(node + offsets).mean(dim=0))


def test_outside_the_border_goes_on():
    lattice = FieldLattice(lambda p: p, BOX, 0.1)
    far = torch.tensor([[[9.0, 0.3, -9.0]]])
    found = lattice(far)[0, 0]
    assert found[0] == pytest.approx(0.5, abs=1e-5) and found[2] == pytest.approx(-0.2, abs=1e-5)


def test_a_point_that_is_nan_gives_nan_and_leaves_the_others_alone():
    lattice = FieldLattice(lambda p: p, BOX, 0.1)
    points = torch.tensor([[[float("nan"), 0.1, 0.1], [0.1, 0.1, 0.1]]])
    found = lattice(points)[0]
    assert found[0].isnan().any() and torch.equal(found[1], lattice(points[:, 1:])[0, 0])


def test_a_spacing_of_nothing_is_refused():
    for spacing in (0.0, 1e-4):
        with pytest.raises(AvatarError, match="spacing"):
            FieldLattice(lambda p: p, BOX, spacing)


def test_the_body_field_is_the_body_on_its_skin_and_a_blend_around_it():
    template = open_body("female").template
    ids = torch.arange(0, len(template.vertices), 37)
    on_skin = template.vertices[ids][None]
    torch.testing.assert_close(BodyField(template)(on_skin)[0], template.weights[ids], atol=2e-3, rtol=0)
    away = on_skin + 0.05
    weights = BodyField(template, 6)(away)[0]
    torch.testing.assert_close(weights.sum(dim=-1), torch.ones(len(ids)))
    vertices = template.vertices.numpy()
    for row in range(0, len(ids), 60):  # the plain formula
        distances = np.linalg.norm(vertices - away[0, row].numpy(), axis=1)
        near = np.argsort(distances)[:6]
        shares = 1 / distances[near] / (1 / distances[near]).sum()
        np.testing.assert_allclose(weights[row], shares @ template.weights.numpy()[near], atol=1e-4)
    one = BodyField(template, 1)(away[:, :1])[0, 0]
    nearest = np.linalg.norm(vertices - away[0, 0].numpy(), axis=1).argmin()
    torch.testing.assert_close(one, template.weights[nearest])
    with pytest.raises(AvatarError, match="neighbours"):
        BodyField(template, 0)
