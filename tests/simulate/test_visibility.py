"""Penetration, visibility and layer order in closed form, on spheres and planes."""

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError
from avatar.simulate.mesh_queries import (
    TUCK_GAP,
    body_distances,
    lift_off,
    penetration_depths,
    tuck,
    view_directions,
    visible_faces,
)

pytest.importorskip("warp")


def sphere(radius: float, subdivisions: int = 4):
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def directions(count: int) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_distance_to_a_sphere():
    vertices, faces = sphere(0.3)
    radii = np.linspace(0.25, 0.45, 100)
    found = body_distances(vertices, faces, directions(100) * radii[:, None], 0.12)
    np.testing.assert_allclose(found, np.minimum(radii - 0.3, 0.12), atol=1e-3)


def test_penetration_of_a_known_share_and_depth():
    vertices, faces = sphere(0.3)
    cloth = directions(200) * 0.32
    cloth[:3] *= np.array([0.296, 0.294, 0.29])[:, None] / 0.32
    depths = penetration_depths(vertices, faces, cloth)
    assert (depths > 0).sum() == 3
    np.testing.assert_allclose(depths[:3], [0.004, 0.006, 0.010], atol=1e-3)
    assert not penetration_depths(vertices, faces, directions(50) * 0.35).any()


def test_distances_refuse_nan():
    with pytest.raises(AvatarError, match="points"):
        body_distances(*sphere(0.3, 1), np.full((2, 3), np.nan), 0.1)


def test_a_covered_sphere_is_unseen_and_the_outer_one_seen_from_outside():
    inner, outer = sphere(0.2, 2), sphere(0.3, 2)
    vertices = np.concatenate([inner[0], outer[0]])
    faces = np.concatenate([inner[1], outer[1] + len(inner[0])])
    views = directions(200)
    seen = visible_faces(vertices, faces, views)
    assert not seen[: len(inner[1])].any() and seen[len(inner[1]) :].all()
    inside_out = faces.copy()
    inside_out[len(inner[1]) :] = inside_out[len(inner[1]) :, ::-1]
    assert not visible_faces(vertices, inside_out, views).any()


def test_a_hole_shows_what_is_behind_it():
    inner, outer = sphere(0.2, 2), sphere(0.3, 3)
    open_faces = outer[1][outer[0][outer[1]].mean(1)[:, 2] < 0.2]
    vertices = np.concatenate([inner[0], outer[0]])
    seen = visible_faces(vertices, np.concatenate([inner[1], open_faces + len(inner[0])]), np.array([[0, 0, 1.0]]))
    front = inner[0][inner[1]].mean(1)
    assert seen[: len(inner[1])][(front[:, 2] > 0.1) & (np.hypot(front[:, 0], front[:, 1]) < 0.15)].all()
    assert not seen[: len(inner[1])][front[:, 2] < 0].any()


def test_views_are_unit_spread_and_never_from_below():
    views = view_directions()
    np.testing.assert_allclose(np.linalg.norm(views, axis=1), 1, atol=1e-12)
    assert len(views) >= 20 and views[:, 1].min() > -0.5
    assert np.abs(views[:, [0, 2]].mean(0)).max() < 0.05


def test_lift_off_moves_only_what_is_too_near():
    vertices, faces = sphere(0.3)
    points = directions(60) * np.linspace(0.28, 0.34, 60)[:, None]
    lifted = lift_off(points, vertices, faces, 0.01)
    radii = np.linalg.norm(lifted, axis=1)
    assert radii.min() > 0.309
    far = np.linalg.norm(points, axis=1) > 0.3105
    np.testing.assert_array_equal(lifted[far], points[far])


def test_tuck_hides_what_shows_and_leaves_what_is_beside():
    axis = np.linspace(-0.1, 0.1, 11)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    sheet = np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3)
    grid = np.arange(121).reshape(11, 11)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])  # normals up
    inner = np.array([[0.013, 0.01, 0.02], [0.04, -0.001, 0.01], [0, -0.02, 0], [0.13, 0.01, 0], [0, 0.05, 0]])
    tucked = tuck(inner, sheet, faces)
    np.testing.assert_allclose(tucked[:2, 1], -TUCK_GAP, atol=1e-6)
    np.testing.assert_allclose(tucked[2:], inner[2:], atol=1e-6)
