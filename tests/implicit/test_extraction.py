"""Hierarchical surfaces: the dense grid's own mesh from a fraction of its evaluations, on closed forms and networks."""

import numpy as np
import pytest
import torch
import trimesh

from avatar.checks import AvatarError
from avatar.implicit.extraction import REACH, ExtractionConfig, extract_surface, largest_parts
from avatar.implicit.networks import PosedSdf, SdfConfig
from avatar.records import Mesh

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def sphere(points):
    return points.norm(dim=-1) - 0.6


def torus(points):
    ring = points[:, [0, 2]].norm(dim=-1) - 0.55
    return (ring.square() + points[:, 1].square()).sqrt() - 0.12


def thin_rod(points):
    """A rod 3 cm across: thinner than a cell of the first pass."""
    along = points[:, 0].clamp(-0.7, 0.7)
    nearest = torch.stack([along, torch.full_like(along, 0.31), torch.full_like(along, -0.17)], dim=-1)
    return (points - nearest).norm(dim=-1) - 0.015


class Counted:
    """A field that counts the points it is asked at."""

    def __init__(self, field):
        self.field, self.evaluations = field, 0

    def __call__(self, points):
        self.evaluations += len(points)
        return self.field(points)


def same_as_dense(field, box, resolution):
    """The mesh, the share of a dense grid's nodes that it took, and their number."""
    sparse, dense = Counted(field), Counted(field)
    found = extract_surface(sparse, box, ExtractionConfig(resolution))
    expected = extract_surface(dense, box, ExtractionConfig(resolution, coarsest=resolution))
    np.testing.assert_array_equal(found.faces, expected.faces)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    return found, sparse.evaluations / dense.evaluations, dense.evaluations


@pytest.mark.parametrize("field", [sphere, torus, thin_rod])
def test_the_mesh_is_that_of_a_dense_grid_for_a_tenth_of_its_work(field):
    mesh, share, nodes = same_as_dense(field, BOX, 128)
    assert share < 0.1 and nodes == 129**3
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight


def test_a_sphere_is_where_it_should_be_and_faces_outwards():
    mesh = extract_surface(sphere, BOX, ExtractionConfig(96))
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radii - 0.6).max() < 5e-4
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=2e-3)  # negative if wound inwards


def test_a_box_of_unequal_sides_has_cubic_cells():
    box = torch.tensor([[-0.7, -1.0, -0.65], [0.66, 1.0, 0.7]])
    mesh, _, nodes = same_as_dense(sphere, box, 64)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.6).max() < 2e-3
    assert nodes < 65**3


def test_the_mesh_of_a_network_is_that_of_a_dense_grid():
    """A network bent at random, with slopes around 1 as trained ones have."""
    torch.manual_seed(0)
    sdf = PosedSdf(0, BOX, SdfConfig(widths=(48, 48, 48), skip=1, orders=4))
    with torch.no_grad():
        for layer in sdf.mlp.layers:
            layer.parametrizations.weight.original1 += 0.02 * torch.randn_like(layer.parametrizations.weight.original1)

    def field(points):
        return sdf(points[None], points.new_zeros(1, len(points), 0))[0]

    places = (2 * torch.rand(20_000, 3) - 1).requires_grad_()
    steepest = torch.autograd.grad(field(places).sum(), places)[0].norm(dim=-1).max().item()
    sparse, dense = Counted(field), Counted(field)
    found = extract_surface(sparse, BOX, ExtractionConfig(64, lipschitz=1.1 * steepest))
    expected = extract_surface(dense, BOX, ExtractionConfig(64, coarsest=64))
    np.testing.assert_array_equal(found.faces, expected.faces)
    np.testing.assert_allclose(found.vertices, expected.vertices, atol=1e-5)  # other batches, other roundings
    assert sparse.evaluations < 0.5 * dense.evaluations


def test_the_reach_is_the_largest_mean_distance_to_the_corners_of_a_cube():
    corners = np.array(np.meshgrid(*[[0, 1]] * 3)).reshape(3, -1).T
    inside = np.concatenate([corners, np.random.default_rng(0).random((5000, 3))])
    means = np.linalg.norm(inside[:, None] - corners, axis=-1).mean(axis=1)
    assert means.max() == pytest.approx(REACH)


def test_the_largest_parts_are_kept():
    def two(points):
        return torch.minimum(sphere(points) + 0.2, (points - 0.8).norm(dim=-1) - 0.1)

    one = extract_surface(two, BOX, ExtractionConfig(48))
    both = extract_surface(two, BOX, ExtractionConfig(48, parts=0))
    assert np.abs(one.vertices).max() < 0.5
    assert len(one.faces) < len(both.faces)
    parts = largest_parts(both, 2)
    assert len(parts.faces) == len(both.faces) and len(parts.vertices) == len(both.vertices)


def test_colours_and_indices_survive_the_choice_of_parts():
    triangles = np.array([[0, 1, 2], [3, 4, 5]])
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [9, 0, 0], [5, 4, 0]], np.float32)
    kept = largest_parts(Mesh(vertices, triangles), 1)
    np.testing.assert_array_equal(kept.vertices[kept.faces[0]], vertices[3:])


def test_a_field_without_surface_is_refused_with_what_it_is():
    with pytest.raises(AvatarError, match=r"expected a zero.*from 1.* to .*Train longer"):
        extract_surface(lambda points: points.norm(dim=-1) + 1, BOX, ExtractionConfig(32))
    with pytest.raises(AvatarError, match="finite"):
        extract_surface(lambda points: points[:, 0] * float("nan"), BOX, ExtractionConfig(32))


@pytest.mark.parametrize("options", [{"resolution": 8}, {"coarsest": 2}, {"lipschitz": 0.0}, {"parts": -1}])
def test_bad_options_are_refused(options):
    with pytest.raises(AvatarError, match=next(iter(options))):
        ExtractionConfig(**options)
