"""Cloth measures in closed form: edges and hinges, strain, bending, contact with the body and with itself."""

import math

import pytest
import torch
from spheres import sphere_template

from avatar.geometry.cloth import ClothMesh, bending, body_contact, edge_strain, self_contact

SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
FACES = torch.tensor([[0, 1, 2], [1, 3, 2]])
CLOTH = ClothMesh.of_faces(FACES)


def folded(angle: float) -> torch.Tensor:
    """The square folded along its diagonal, ``(1, 4, 3)``; a positive angle brings the fourth corner to the front."""
    middle, out = torch.tensor([0.5, 0.5, 0]), torch.tensor([0.5, 0.5, 0])
    corner = middle + out * math.cos(angle) + torch.tensor([0, 0, 1.0]) * math.sin(angle) * out.norm()
    return torch.cat([SQUARE[:3], corner[None]])[None]


def test_a_square_of_two_faces_has_five_edges_and_one_hinge():
    assert len(CLOTH.edges) == 5 and CLOTH.hinges[:, :2].sort().values.tolist() == [[1, 2]]
    assert CLOTH.hinges[:, 2:].sort().values.tolist() == [[0, 3]]
    closed = ClothMesh.of_faces(sphere_template(1).faces)
    assert len(closed.edges) == len(closed.hinges) == 120


def test_strain_is_that_of_a_stretched_square():
    rest = CLOTH.edge_lengths(SQUARE[None])
    assert edge_strain(rest, rest) == 0
    assert float(edge_strain(CLOTH.edge_lengths(1.1 * SQUARE[None]), rest)) == pytest.approx(0.01, rel=1e-4)


@pytest.mark.parametrize("angle", [-2.5, -0.3, 0.4, 3.0])
def test_bending_is_the_change_of_the_angle_on_either_side(angle):
    flat = CLOTH.angles(SQUARE[None])
    assert abs(float(flat)) < 1e-6
    assert abs(float(CLOTH.angles(folded(angle)))) == pytest.approx(abs(angle), rel=1e-4)
    assert float(CLOTH.angles(folded(angle))) == pytest.approx(-float(CLOTH.angles(folded(-angle))), rel=1e-4)
    for rest in (flat, None):
        assert float(bending(CLOTH.angles(folded(angle)), rest)) == pytest.approx(angle**2, rel=1e-3)
    near = bending(CLOTH.angles(folded(3.1)), CLOTH.angles(folded(-3.1)))  # across the half turn
    assert float(near) == pytest.approx((2 * math.pi - 6.2) ** 2, rel=1e-2)


def test_angles_have_gradients_where_faces_have_no_area():
    vertices = torch.zeros(1, 4, 3, requires_grad=True)
    CLOTH.angles(vertices).sum().backward()
    assert torch.isfinite(vertices.grad).all()


def test_differences_are_to_the_mean_of_neighbours():
    values = torch.tensor([[[0.0], [1.0], [3.0], [8.0]]])
    expected = [0 - 2.0, 1 - (0 + 3 + 8) / 3, 3 - (0 + 1 + 8) / 3, 8 - 2.0]
    torch.testing.assert_close(CLOTH.differences(values)[0, :, 0], torch.tensor(expected))
    moved = values.clone().requires_grad_()
    torch.autograd.gradcheck(CLOTH.differences, (moved.double(),))


def test_contact_with_the_body_counts_what_is_nearer_than_the_gap():
    body = sphere_template(3)
    points = torch.stack([body.vertices[:4] * scale for scale in (0.99, 1.001, 1.2)])[:, None]
    found = [float(body_contact(each, body.vertices[None], body.faces, 0.003)) for each in points]
    assert found == pytest.approx([0.013**2, 0.002**2, 0], rel=0.02, abs=1e-12)


def test_contact_with_itself_counts_what_is_apart_at_rest():
    rest = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [0.5, 0, 0]])
    folded = torch.tensor([[[0.0, 0, 0], [0.01, 0, 0], [0.0, 0.002, 0]]])
    assert float(self_contact(rest[None], rest, 0.003, 0.04)) == 0
    assert float(self_contact(folded, rest, 0.003, 0.04)) == pytest.approx(2 / 3 * 0.001**2, rel=1e-3)
