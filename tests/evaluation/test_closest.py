"""Closest points on meshes against closed forms, trimesh, and winding numbers."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from avatar.body.open import open_body
from avatar.checks import AvatarError
from avatar.evaluation.shapes import closest_on_mesh, closest_on_triangles


def posed_mesh():
    body = open_body("female")
    pose = 0.3 * torch.randn(1, 22, 3, generator=torch.Generator().manual_seed(3))
    return body(pose).vertices[0].double().numpy(), body.faces.numpy()


def winding_numbers(queries, vertices, faces):
    """Solid angle of the whole mesh over 4 pi: 1 inside, 0 outside (van Oosterom and Strackee 1983)."""
    a, b, c = (vertices[faces[:, i]] - queries[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    triple = (a * np.cross(b, c)).sum(-1)
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(triple, below).sum(axis=1) / (2 * np.pi)


def test_cube_face_edge_corner_and_inside():
    cube = trimesh.creation.box(extents=(2, 2, 2))
    queries = np.array([[0.3, 0.2, 1.5], [0, 2, 2], [2, 2, 2], [0.9, 0, 0], [0, 0, 0]], float)
    hits = closest_on_mesh(queries, cube.vertices, cube.faces)
    expected = [[0.3, 0.2, 1], [0, 1, 1], [1, 1, 1], [1, 0, 0]]
    np.testing.assert_allclose(hits.points[:4], expected, atol=1e-12)
    np.testing.assert_allclose(hits.signed_distances, [0.5, 2**0.5, 3**0.5, -0.1, -1], atol=1e-12)


@pytest.mark.parametrize("height", [1.0, -0.5])
@pytest.mark.parametrize("turns", [np.linspace(0, 6, 7), np.r_[np.linspace(0, 0.6, 40), 2.2, 3.6, 5]])
def test_side_of_a_spike_and_of_a_dent(height, turns):
    """Around an edge or tip single face normals err, and so does their plain mean where many triangles share a side."""
    ring = np.stack([0.3 * np.cos(turns), 0.3 * np.sin(turns), 0 * turns], axis=1)
    vertices = np.concatenate([[[0, 0, height], [0, 0, -1]], ring])
    here = 2 + np.arange(len(turns))
    after = np.roll(here, -1)
    faces = np.concatenate([np.stack([0 * here, here, after], 1), np.stack([0 * here + 1, after, here], 1)])
    queries = vertices[:1] + 0.05 * np.random.default_rng(0).normal(size=(600, 3))
    hits = closest_on_mesh(queries, vertices, faces)
    inside = winding_numbers(queries, vertices, faces) > 0.5
    assert 5 < inside.sum() < 595
    assert (np.linalg.norm(hits.points - vertices[0], axis=1) < 1e-12).sum() > 20
    np.testing.assert_array_equal(hits.signed_distances < 0, inside)


def test_agrees_with_trimesh_triangle_by_triangle():
    random = np.random.default_rng(1)
    corners, queries = random.normal(size=(5000, 3, 3)), 2 * random.normal(size=(5000, 3))
    points, weights = closest_on_triangles(queries, corners)
    np.testing.assert_allclose(points, trimesh.triangles.closest_point(corners, queries), atol=1e-9)
    np.testing.assert_allclose((weights[..., None] * corners).sum(axis=1), points, atol=1e-9)
    np.testing.assert_allclose(weights.sum(axis=1), 1)


@pytest.mark.parametrize("stretch", [1.0, 40.0])
def test_search_finds_the_closest_of_all_triangles(stretch):
    """Long thin triangles among small ones are where a search by centroids alone goes wrong."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.vertices[:, 0] *= np.where(mesh.vertices[:, 0] > 0.5, stretch, 1.0)
    mesh.vertices *= np.random.default_rng(3).uniform(0.97, 1.03, size=(len(mesh.vertices), 1))
    queries = np.random.default_rng(2).uniform(-2, 2, size=(200, 3))
    queries[:, 0] *= stretch / 2
    queries[::2] *= 0.05  # about as far from everything: the first triangles tried are seldom the closest
    hits = closest_on_mesh(queries, mesh.vertices, mesh.faces)
    every = trimesh.triangles.closest_point(
        np.tile(mesh.triangles, (len(queries), 1, 1)), np.repeat(queries, len(mesh.faces), axis=0)
    )
    gaps = np.linalg.norm(every.reshape(len(queries), -1, 3) - queries[:, None], axis=2)
    np.testing.assert_allclose(np.abs(hits.signed_distances), gaps.min(axis=1), atol=1e-9)


def test_posed_body_distance_and_side_agree_with_brute_force():
    vertices, faces = posed_mesh()
    random = np.random.default_rng(4)
    queries = vertices[random.integers(len(vertices), size=60)] + 0.02 * random.normal(size=(60, 3))
    hits = closest_on_mesh(queries, vertices, faces)
    for query, distance in zip(queries[:12], hits.signed_distances):
        points = trimesh.triangles.closest_point(vertices[faces], np.repeat(query[None], len(faces), axis=0))
        assert abs(distance) == pytest.approx(np.linalg.norm(points - query, axis=1).min(), abs=1e-9)
    inside = winding_numbers(queries, vertices, faces)
    clear = np.abs(inside - np.rint(inside)) < 0.05  # limbs of a random pose may cross: count those points out
    once = clear & np.isin(np.rint(inside), (0, 1))
    assert once.sum() > 50
    assert (hits.signed_distances < 0)[once].tolist() == (np.rint(inside) == 1)[once].tolist()


def test_far_points_are_nearly_exact_when_that_will_do():
    vertices, faces = posed_mesh()
    queries = vertices[::20] + 0.1 * np.random.default_rng(5).normal(size=(len(vertices[::20]), 3))
    exact, near = (closest_on_mesh(queries, vertices, faces, within).signed_distances for within in (np.inf, 0.01))
    close = np.abs(near) <= 0.01
    assert 20 < close.sum() < 400
    np.testing.assert_array_equal(near[close], exact[close])
    assert (np.sign(near) == np.sign(exact)).mean() > 0.995
    excess = np.abs(near) - np.abs(exact)
    assert excess.min() > -1e-12 and excess.max() < 3e-3


def test_rigid_motion_changes_no_distance():
    vertices, faces = posed_mesh()
    queries = vertices[::50] + 0.01
    rotation, shift = Rotation.from_rotvec([0.3, 1.1, -0.4]).as_matrix(), np.array([3.0, -1, 2])
    moved = closest_on_mesh(queries @ rotation.T + shift, vertices @ rotation.T + shift, faces)
    still = closest_on_mesh(queries, vertices, faces)
    np.testing.assert_allclose(moved.signed_distances, still.signed_distances, atol=1e-9)


def test_triangles_without_area_do_not_matter():
    cube = trimesh.creation.box()
    faces = np.concatenate([cube.faces, [[0, 0, 1], [2, 2, 2]]])
    queries = np.random.default_rng(0).normal(size=(50, 3))
    thin, plain = (closest_on_mesh(queries, cube.vertices, f) for f in (faces, cube.faces))
    np.testing.assert_allclose(np.abs(thin.signed_distances), np.abs(plain.signed_distances), atol=1e-12)


def test_bad_input_is_named():
    cube = trimesh.creation.box()
    with pytest.raises(AvatarError, match="faces"):
        closest_on_mesh(np.zeros((1, 3)), cube.vertices, np.zeros((0, 3), int))
    with pytest.raises(AvatarError, match=r"queries.*NaN"):
        closest_on_mesh(np.full((1, 3), np.nan), cube.vertices, cube.faces)
