"""Scans unposed to the canonical pose: positions, normals, cuts; and the baselines' weights."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from limbs import arm_frame, arm_template, true_weights

from avatar.canonical.fields import KNN, BodyField
from avatar.canonical.scans import canonicalize_scan, cut_stretched, edge_stretch
from avatar.checks import AvatarError
from avatar.records import Scan

TEMPLATE = arm_template()


def truth(frame) -> np.ndarray:
    return true_weights(torch.from_numpy(frame.scan.canonical)).numpy()


def around(points: np.ndarray) -> np.ndarray:
    """Unit directions away from the tube's axis."""
    flat = points * [1, 0, 1]
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


@pytest.mark.parametrize("mesh", [False, True])
def test_true_weights_bring_points_and_normals_home_whatever_the_global_motion(mesh):
    frame = arm_frame(0.6, -0.3, mesh)
    colors = np.random.default_rng(0).random(frame.scan.points.shape).astype(np.float32)
    scan = canonicalize_scan(replace(frame.scan, colors=colors), frame.body, truth(frame), TEMPLATE, np.inf)
    assert np.array_equal(scan.source, np.arange(len(frame.scan.points)))
    np.testing.assert_allclose(scan.points, frame.scan.canonical, atol=1e-5)
    np.testing.assert_allclose(scan.normals, around(scan.points), atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1, atol=1e-5)
    assert np.array_equal(scan.colors, colors)
    assert (scan.faces is None) == (not mesh)
    if mesh:
        assert np.array_equal(scan.faces, frame.scan.faces)


def test_normals_stay_perpendicular_to_a_sheared_surface():
    """Blended transforms shear: where they do, turning normals as directions would be wrong."""
    frame = arm_frame(1.5, mesh=True)
    weights = np.full((len(frame.scan.points), 3), [0.5, 0.5, 0], np.float32)  # one affine map, far from a rotation
    scan = canonicalize_scan(frame.scan, frame.body, weights, TEMPLATE, np.inf)
    straight = np.abs(frame.scan.canonical[:, 1] - 0.2) < 0.12  # the sleeve is a true cylinder there
    inner = straight[scan.faces].all(axis=1)
    a, b, c = (scan.points[scan.faces[inner][:, corner]] for corner in range(3))
    face_normals = np.cross(b - a, c - a)
    face_normals /= np.linalg.norm(face_normals, axis=1, keepdims=True)
    mean = scan.normals[scan.faces[inner]].mean(axis=1)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    assert np.abs(np.einsum("nc,nc->n", face_normals, mean)).min() > 0.995


def ladder() -> Scan:
    """A strip of 10 triangles, 1 cm wide, along x."""
    points = np.array([[0.01 * (i // 2), 0.01 * (i % 2), 0] for i in range(12)], np.float32)
    faces = np.array([[i, i + 1, i + 2] for i in range(10)])
    return Scan(points, np.tile(np.float32([0, 0, 1]), (12, 1)), faces)


def test_stretched_triangles_go_and_points_without_any_with_them():
    strip = ladder()
    moved = strip.points.copy()
    moved[6:, 0] += 0.05  # edges across the gap: from 1 cm to 6 cm
    kept, faces = cut_stretched(strip, moved, 4.0)
    assert np.array_equal(kept, np.arange(12)) and len(faces) == 8  # the two that span the gap
    assert not any({4, 6} <= set(face) or {5, 7} <= set(face) or {5, 6} <= set(face) for face in kept[faces].tolist())
    assert len(cut_stretched(strip, moved, 6.5)[1]) == 10
    moved[0] += 0.05  # the first corner alone
    kept, faces = cut_stretched(strip, moved, 4.0)
    assert np.array_equal(kept, np.arange(1, 12)) and faces.max() == 10 and len(faces) == 7


@pytest.mark.parametrize("first", range(3))
def test_any_one_edge_that_is_stretched_cuts_a_triangle(first):
    near, after = ([[0.0, 0, 0], [1, 0, 0], [along, 0, 0]] for along in (0.1, 0.6))
    scan = Scan(np.array(near), np.zeros((3, 3)), np.roll([[0, 1, 2]], first))
    assert len(cut_stretched(scan, np.array(after), 5.5)[1]) == 0  # the edge from third to first is six times longer
    assert len(cut_stretched(scan, np.array(after), 6.5)[1]) == 1


def test_edges_that_shrink_or_have_no_length_are_not_stretched():
    edges = np.array([[0, 1], [1, 2], [0, 0]])
    before, after = np.eye(3), 0.1 * np.eye(3)
    np.testing.assert_allclose(edge_stretch(edges, before, after), [0.1, 0.1, 1], atol=1e-6)


def test_a_point_scan_loses_points_that_parted_from_most_of_their_neighbours():
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2) * 0.01
    points = np.concatenate([grid, np.zeros((400, 1))], axis=1).astype(np.float32)
    moved = points.copy()
    moved[210] += [0, 0, 0.3]  # one point torn out; its neighbours lose one edge each
    kept, faces = cut_stretched(Scan(points, points), moved, 4.0)
    assert faces is None and sorted(set(range(400)) - set(kept)) == [210]
    halves = points + np.where(points[:, :1] > 0.095, [0.5, 0, 0], 0)
    assert len(cut_stretched(Scan(points, points), halves, 4.0)[0]) == 400  # each keeps most of its neighbours


def test_wrong_weights_and_scans_of_which_nothing_is_left_are_refused():
    frame = arm_frame(0.6, mesh=True)
    with pytest.raises(AvatarError, match="weights"):
        canonicalize_scan(frame.scan, frame.body, truth(frame)[:-1], TEMPLATE)
    with pytest.raises(AvatarError, match="finite"):
        canonicalize_scan(frame.scan, frame.body, truth(frame) * np.nan, TEMPLATE)
    with pytest.raises(AvatarError, match="nothing did"):
        canonicalize_scan(frame.scan, frame.body, truth(frame), TEMPLATE, 1e-3)


def test_nearest_body_takes_the_weights_of_the_vertex_it_lies_on():
    frame = arm_frame(1.0)
    found = BodyField(TEMPLATE, 1).weights_of(frame.body.vertices[::7], frame)
    np.testing.assert_allclose(found, TEMPLATE.weights.numpy()[::7], atol=1e-6)
    blended = BodyField(TEMPLATE, KNN).weights_of(frame.body.vertices[::7], frame)
    np.testing.assert_allclose(blended, TEMPLATE.weights.numpy()[::7], atol=1e-5)  # distance 0 has all the say


def test_knn_weighs_by_inverse_distance():
    frame = arm_frame(1.0)
    points = frame.scan.points[::20]
    distances = np.linalg.norm(points[:, None] - frame.body.vertices, axis=-1)
    for count in (1, KNN):
        order = np.argsort(distances, axis=1)[:, :count]
        closeness = 1 / np.take_along_axis(distances, order, axis=1)
        expected = (closeness[..., None] * TEMPLATE.weights.numpy()[order]).sum(axis=1) / closeness.sum(1)[:, None]
        np.testing.assert_allclose(BodyField(TEMPLATE, count).weights_of(points, frame), expected, atol=1e-5)
    with pytest.raises(AvatarError, match="neighbours"):
        BodyField(TEMPLATE, 0)
