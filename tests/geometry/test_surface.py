"""Surfaces: areas and normals in closed form, sampling by statistics, interpolation against its loop."""

import math

import numpy as np
import pytest
import scipy.stats
import torch
import trimesh
from reference import barycentric_loop

from avatar.checks import AvatarError
from avatar.geometry.surface import (
    face_areas,
    interpolate,
    interpolate_transforms,
    sample_surface,
    vertex_normals,
)
from avatar.geometry.transforms import transform_points

FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def sphere(subdivisions: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions)
    return torch.tensor(mesh.vertices), torch.tensor(mesh.faces).long()


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_areas_in_closed_form_and_against_trimesh():
    vertices = torch.tensor([[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0]])
    torch.testing.assert_close(face_areas(vertices, FACES), torch.tensor([6.0, 6.0]))
    ball = trimesh.creation.icosphere(2)
    areas = face_areas(torch.tensor(ball.vertices), torch.tensor(ball.faces))
    np.testing.assert_allclose(areas.numpy(), ball.area_faces)


def test_vertex_normals_point_out_of_a_sphere_and_up_from_a_floor():
    vertices, faces = sphere()
    torch.testing.assert_close(vertex_normals(vertices, faces), vertices, atol=0.02, rtol=0)
    floor = torch.tensor([[[0.0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0]]])
    torch.testing.assert_close(vertex_normals(floor, FACES), torch.tensor([0.0, 1, 0]).expand(1, 4, 3))


def test_vertex_normals_are_weighted_by_area():
    """A wall and a floor that meet along z, the wall twice as large."""
    vertices = torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 2, 0]])
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2], [0, 3, 1]]))
    torch.testing.assert_close(normals[:2], torch.tensor([2.0, 1, 0]).expand(2, 3) / 5**0.5)
    torch.testing.assert_close(normals[2:], torch.tensor([[0.0, 1, 0], [1, 0, 0]]))


def test_vertex_normals_of_millimetre_triangles_and_unused_vertices():
    vertices, faces = sphere()
    tiny = torch.cat([vertices.float() * 1e-3, torch.zeros(1, 3)])
    normals = vertex_normals(tiny, faces)
    torch.testing.assert_close(normals[:-1].norm(dim=-1), torch.ones(len(vertices)))
    assert normals[-1].tolist() == [0, 0, 0]


def test_samples_lie_on_their_triangles():
    vertices, faces = sphere()
    samples = sample_surface(vertices, faces, 1000, generator())
    torch.testing.assert_close(samples.barycentric.sum(dim=-1), torch.ones(1000, dtype=torch.float64))
    assert samples.barycentric.min() >= 0
    assert torch.equal(samples.vertex_ids, faces[samples.face_ids])
    points = interpolate(vertices, samples).numpy()
    closest = trimesh.triangles.closest_point(vertices.numpy()[samples.vertex_ids.numpy()], points)
    np.testing.assert_allclose(closest, points, atol=1e-12)


def test_samples_are_spread_by_area():
    """Each face's count stays within one of its share of the area, and inside a face the spread is uniform."""
    vertices, faces = sphere(1)
    vertices = vertices * torch.tensor([1.0, 2.0, 0.3])
    count = 20_000
    samples = sample_surface(vertices, faces, count, generator())
    shares = face_areas(vertices, faces)
    expected = shares / shares.sum() * count
    counts = torch.bincount(samples.face_ids, minlength=len(faces))
    assert (counts - expected).abs().max() < 2  # a stretch is off by less than one at each of its two ends
    root, along = 1 - samples.barycentric[:, 0], samples.barycentric[:, 2] / (1 - samples.barycentric[:, 0])
    cells = (root.square() * 10).long().clamp(max=9) * 10 + (along * 10).long().clamp(max=9)
    _, chance = scipy.stats.chisquare(torch.bincount(cells, minlength=100).numpy())
    assert chance > 1e-3


def test_independent_seeds_hit_faces_by_area():
    """First samples of many draws, one a draw, so that stratification plays no part."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [-2, 1, 0]])
    shares = face_areas(vertices, FACES).double().numpy()
    hits = np.zeros(2)
    source = generator()
    for _ in range(2000):
        hits[int(sample_surface(vertices, FACES, 1, source).face_ids)] += 1
    _, chance = scipy.stats.chisquare(hits, shares / shares.sum() * 2000)
    assert chance > 1e-3


def test_same_seed_same_bits_and_other_seed_other_points():
    vertices, faces = sphere()
    first, again, other = (sample_surface(vertices, faces, 500, generator(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.barycentric, again.barycentric) and torch.equal(first.face_ids, again.face_ids)
    assert not torch.equal(first.barycentric, other.barycentric)


def test_faces_without_area_are_never_hit():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 0, 1], [0, 1, 2], [1, 1, 1], [0, 2, 3], [2, 3, 3]])
    assert sample_surface(vertices, faces, 1000, generator()).face_ids.unique().tolist() == [1, 3]


@pytest.mark.parametrize("vertices", [torch.zeros(4, 3), torch.full((4, 3), float("nan"))])
def test_surfaces_without_area_are_refused(vertices):
    with pytest.raises(AvatarError, match="surface with area"):
        sample_surface(vertices, FACES, 10, generator())


def test_empty_surface_and_count_are_refused():
    with pytest.raises(AvatarError, match="surface with area"):
        sample_surface(torch.rand(4, 3), FACES[:0], 10, generator())
    with pytest.raises(AvatarError, match="count"):
        sample_surface(torch.rand(4, 3), FACES, 0, generator())


def test_interpolate_agrees_with_loop_for_any_leading_dimensions():
    vertices, faces = sphere(1)
    samples = sample_surface(vertices, faces, 50, generator())
    values = torch.randn(2, 3, len(vertices), 5, generator=generator(), dtype=torch.float64)
    found = interpolate(values, samples)
    assert found.shape == (2, 3, 50, 5)
    expected = barycentric_loop(values[1, 2].numpy(), samples.vertex_ids.numpy(), samples.barycentric.numpy())
    np.testing.assert_allclose(found[1, 2].numpy(), expected, atol=1e-12)


def test_interpolate_is_exact_on_linear_functions():
    vertices, faces = sphere(1)
    samples = sample_surface(vertices, faces, 200, generator())
    slope, offset = torch.tensor([1.0, -2, 3], dtype=torch.float64), 0.7
    values = (vertices @ slope + offset)[:, None]
    expected = interpolate(vertices, samples) @ slope + offset
    torch.testing.assert_close(interpolate(values, samples)[:, 0], expected)


def test_interpolate_gradient():
    vertices, faces = sphere(0)
    samples = sample_surface(vertices, faces, 6, generator())
    values = torch.randn(len(vertices), 2, dtype=torch.float64, generator=generator(), requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: interpolate(v, samples), values)


def test_blended_transforms_move_like_blended_vertices():
    """With one transform for all, blending transforms and blending positions agree."""
    vertices, faces = sphere(1)
    samples = sample_surface(vertices, faces, 50, generator())
    turn = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], dtype=torch.float64)
    transforms = interpolate_transforms(turn.expand(2, len(vertices), 4, 4), samples)
    assert transforms.shape == (2, 50, 4, 4)
    moved = transform_points(transforms[0], interpolate(vertices, samples))
    torch.testing.assert_close(moved, interpolate(transform_points(turn, vertices), samples))


def test_area_of_a_fine_sphere_is_four_pi():
    vertices, faces = sphere(5)
    assert float(face_areas(vertices, faces).sum()) == pytest.approx(4 * math.pi, rel=1e-3)
