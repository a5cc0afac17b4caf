"""Distances in closed form, against the loop, under rigid motion, and their gradients."""

import math

import pytest
import torch
from reference import chamfer_loop

from avatar.checks import AvatarError
from avatar.geometry.neighbours import correspond, normal_difference, point_to_plane, point_to_point
from avatar.geometry.sparse import gather_rows
from avatar.geometry.transforms import rotation_from_axis_angle


def random_points(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(vectors: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1)


def test_chamfer_agrees_with_loop():
    points, scan = random_points(2, 30, seed=0), random_points(2, 20, seed=1)
    pairs = correspond(points, scan)
    there = point_to_point(points, gather_rows(scan, pairs.scan_of_point)).mean(dim=-1)
    back = point_to_point(scan, gather_rows(points, pairs.point_of_scan)).mean(dim=-1)
    for b in range(2):
        assert (float(there[b]), float(back[b])) == pytest.approx(chamfer_loop(points[b].numpy(), scan[b].numpy()))


def test_plane_above_plane():
    """A grid lifted by h over a grid: h^2 both ways; moved sideways by d, only point-to-point grows."""
    grid = torch.cartesian_prod(torch.arange(5.0), torch.zeros(1), torch.arange(5.0))[None].double()
    up = torch.tensor([0.0, 1, 0], dtype=torch.float64).expand_as(grid)
    lifted = grid + torch.tensor([0.2, 0.1, 0.0], dtype=torch.float64)
    ids = correspond(lifted, grid).scan_of_point
    assert ids.tolist() == [list(range(25))]
    anchors = gather_rows(grid, ids)
    torch.testing.assert_close(point_to_point(lifted, anchors), torch.full((1, 25), 0.05, dtype=torch.float64))
    torch.testing.assert_close(point_to_plane(lifted, anchors, up), torch.full((1, 25), 0.01, dtype=torch.float64))


def test_sphere_inside_sphere():
    """Points at radius 1.1 over points at radius 1 in the same directions: 0.01 by both distances."""
    directions = unit(random_points(1, 200, seed=0))
    ids = correspond(1.1 * directions, directions).scan_of_point
    assert torch.equal(ids[0], torch.arange(200))
    anchors = gather_rows(directions, ids)
    expected = torch.full((1, 200), 0.01, dtype=torch.float64)
    torch.testing.assert_close(point_to_point(1.1 * directions, anchors), expected)
    torch.testing.assert_close(point_to_plane(1.1 * directions, anchors, anchors), expected)


def test_normal_difference_in_closed_form():
    x, y = torch.eye(3, dtype=torch.float64)[:2, None, None]
    assert normal_difference(x, x).item() == 0
    assert normal_difference(x, y).item() == 2
    diagonal = unit(torch.ones(1, 1, 3, dtype=torch.float64))
    assert normal_difference(diagonal, -diagonal).item() == pytest.approx(2 * math.sqrt(3))


def test_rigid_motion_changes_no_distance():
    points, anchors, normals = (random_points(2, 10, seed=s) for s in range(3))
    rotation, shift = rotation_from_axis_angle(random_points(seed=3)), random_points(seed=4)
    moved = [points @ rotation.T + shift, anchors @ rotation.T + shift]
    torch.testing.assert_close(point_to_point(*moved), point_to_point(points, anchors))
    plane = point_to_plane(*moved, unit(normals) @ rotation.T)
    torch.testing.assert_close(plane, point_to_plane(points, anchors, unit(normals)))


def test_gradients():
    points, anchors, normals = (random_points(1, 4, seed=s).requires_grad_() for s in range(3))
    assert torch.autograd.gradcheck(point_to_point, (points, anchors))
    assert torch.autograd.gradcheck(point_to_plane, (points, anchors, normals))
    assert torch.autograd.gradcheck(normal_difference, (points, anchors))


def test_coinciding_points_have_zero_distance_and_gradient():
    points = random_points(1, 5, seed=0).requires_grad_()
    distances = point_to_point(points, points.detach())
    distances.sum().backward()
    assert distances.abs().max() == 0 and points.grad.abs().max() == 0


def test_gather_rows_picks_rows_of_each_batch():
    values = torch.arange(12.0).reshape(2, 3, 2)
    ids = torch.tensor([[2, 0], [1, 1]])
    assert gather_rows(values, ids).tolist() == [[[4, 5], [0, 1]], [[8, 9], [8, 9]]]


def test_shapes_are_checked():
    with pytest.raises(AvatarError, match="anchors: expected shape"):
        point_to_point(torch.zeros(1, 4, 3), torch.zeros(1, 5, 3))
    with pytest.raises(AvatarError, match="normals: expected shape"):
        point_to_plane(torch.zeros(1, 4, 3), torch.zeros(1, 4, 3), torch.zeros(4, 3))
