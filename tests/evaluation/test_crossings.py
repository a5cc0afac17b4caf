"""Self-intersection of meshes: known cuts, and loops over all pairs by another test."""

import itertools

import numpy as np
import trimesh

from avatar.evaluation.shapes import crossing_faces


def both(first, second):
    mesh = trimesh.util.concatenate([first, second])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_closed_surfaces_do_not_cross_and_shifted_ones_cross_along_their_circle():
    ball = trimesh.creation.icosphere(3)
    assert not crossing_faces(ball.vertices, ball.faces).any()
    other = ball.copy().apply_translation([1.5, 0, 0])
    vertices, faces = both(ball, other)
    found = crossing_faces(vertices, faces)
    centers = vertices[faces[found]].mean(axis=1)
    assert found.sum() > 40 and np.abs(centers[:, 0] - 0.75).max() < 0.15
    assert not crossing_faces(*both(ball, ball.copy().apply_translation([2.5, 0, 0]))).any()


def test_agrees_with_segments_against_planes_over_all_pairs():
    random = np.random.default_rng(0)
    vertices = random.normal(size=(90, 3))
    faces = np.arange(90).reshape(-1, 3)
    expected = np.zeros(len(faces), bool)
    for i, j in itertools.permutations(range(len(faces)), 2):
        a, b, c = vertices[faces[j]]
        for p, q in itertools.pairwise([*vertices[faces[i]], vertices[faces[i][0]]]):
            signs = [np.linalg.det([x - p, y - p, q - p]) for x, y in ((a, b), (b, c), (c, a))]
            heights = [np.linalg.det([b - a, c - a, x - a]) for x in (p, q)]
            if heights[0] * heights[1] < 0 and (min(signs) > 0 or max(signs) < 0):
                expected[[i, j]] = True
    assert expected.sum() > 0
    assert (crossing_faces(vertices, faces) == expected).all()


def test_long_faces_among_small_ones_are_found():
    ball = trimesh.creation.icosphere(3)
    spike = trimesh.Trimesh([[-5, 0.01, 0.02], [5, 0.02, 0.03], [5, 0.03, 0.05]], [[0, 1, 2]])
    found = crossing_faces(*both(ball, spike))
    assert found[-1] and found.sum() >= 3
