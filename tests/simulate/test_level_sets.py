"""Surface nets, clipping and cleaning against spheres and planes."""

import numpy as np
import pytest
import trimesh

from avatar.simulate.level_sets import (
    Grid,
    clip,
    collapse_short_edges,
    drop_ears,
    flip_edges,
    largest_component,
    mesh_edges,
    relax,
    surface_nets,
)

RADIUS = 0.2


@pytest.fixture(scope="module")
def sphere_grid() -> Grid:
    step = 0.02
    axis = np.arange(-0.3, 0.3, step)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return Grid(np.linalg.norm(points, axis=-1) - RADIUS, np.full(3, -0.3), step)


def angles(vertices, faces):
    """Smallest angle of each face, degrees."""
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    return np.degrees(np.arccos(np.clip(-(sides * np.roll(sides, 1, axis=1)).sum(2), -1, 1))).min(1)


def test_surface_nets_give_a_closed_outward_sphere(sphere_grid):
    vertices, faces = surface_nets(sphere_grid)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 2
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 0.1 * sphere_grid.step
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)


def test_projection_finds_the_level_set(sphere_grid):
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= (RADIUS + 0.008) / np.linalg.norm(points, axis=1, keepdims=True)
    for _ in range(3):
        points = sphere_grid.project(points)
    assert np.abs(np.linalg.norm(points, axis=1) - RADIUS).max() < 1e-3


def test_clip_cuts_along_the_level_without_slivers(sphere_grid):
    vertices, faces = surface_nets(sphere_grid)
    vertices = relax(vertices, faces, sphere_grid, 6)
    cut, kept = clip(vertices, faces, vertices[:, 1] - 0.053)
    edges, counts = mesh_edges(kept)
    rim = np.unique(edges[counts == 1])
    assert np.abs(cut[rim, 1] - 0.053).max() < 1e-9 and cut[:, 1].max() < 0.053 + 1e-9
    assert counts.max() == 2
    cap = 2 * np.pi * RADIUS * (RADIUS - 0.053)
    area = trimesh.Trimesh(cut, kept, process=False).area
    assert area == pytest.approx(4 * np.pi * RADIUS**2 - cap, rel=0.02)
    lengths = np.linalg.norm(cut[edges[:, 0]] - cut[edges[:, 1]], axis=1)
    assert lengths.min() > 0.1 * sphere_grid.step


def test_clip_of_nothing_keeps_all_and_of_all_keeps_nothing(sphere_grid):
    vertices, faces = surface_nets(sphere_grid)
    same, kept = clip(vertices, faces, np.full(len(vertices), -1.0))
    np.testing.assert_array_equal(same[kept], vertices[faces])
    assert len(clip(vertices, faces, np.ones(len(vertices)))[1]) == 0


def test_short_edges_collapse_and_the_surface_stays_closed(sphere_grid):
    vertices, faces = surface_nets(sphere_grid)
    before = vertices.copy()
    fewer, kept = collapse_short_edges(vertices, faces, 0.015)
    np.testing.assert_array_equal(vertices, before)
    edges, counts = mesh_edges(kept)
    lengths = np.linalg.norm(fewer[edges[:, 0]] - fewer[edges[:, 1]], axis=1)
    assert len(fewer) < len(vertices) and lengths.min() >= 0.015 and (counts == 2).all()
    assert trimesh.Trimesh(fewer, kept, process=False).euler_number == 2


def test_flip_turns_the_one_bad_diagonal():
    square = np.array([[0.0, 0, 0], [1, -0.2, 0], [2, 0, 0], [1, 0.2, 0]])
    faces = flip_edges(square, np.array([[0, 1, 2], [0, 2, 3]]))
    assert {tuple(sorted(face)) for face in faces.tolist()} == {(0, 1, 3), (1, 2, 3)}
    normals = np.cross(square[faces[:, 1]] - square[faces[:, 0]], square[faces[:, 2]] - square[faces[:, 0]])
    assert (normals[:, 2] > 0).all()


def test_cleaning_makes_good_triangles(sphere_grid):
    vertices, faces = clip(*surface_nets(sphere_grid), surface_nets(sphere_grid)[0][:, 1] - 0.051)
    vertices, faces = largest_component(vertices, drop_ears(faces))
    for _ in range(3):
        vertices, faces = collapse_short_edges(vertices, faces, 0.009)
        faces = flip_edges(vertices, faces)
        vertices = relax(vertices, faces, sphere_grid, 8)
    assert angles(vertices, faces).min() > 22
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 0.1 * sphere_grid.step


def test_largest_component_and_ears():
    vertices = np.random.default_rng(0).normal(size=(8, 3))
    strip = np.array([[0, 1, 2], [1, 3, 2], [1, 0, 4], [0, 2, 4], [2, 3, 4], [3, 1, 4]])
    both = np.concatenate([strip, [[5, 6, 7]]])
    assert len(largest_component(vertices, both)[1]) == len(strip)
    assert len(drop_ears(np.concatenate([strip, [[3, 5, 4]]]))) <= len(strip)
