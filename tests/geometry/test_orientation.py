"""Winding of meshes: shares of flipped faces, signed volumes, open and separate pieces, edges of many faces."""

import numpy as np
import pytest
import trimesh

from avatar.geometry.orientation import measure_winding


@pytest.fixture
def ball():
    solid = trimesh.creation.icosphere(2)
    return np.array(solid.vertices), np.array(solid.faces)


def test_a_ball_wound_outward_has_its_volume(ball):
    vertices, faces = ball
    winding = measure_winding(vertices + 7, faces)
    assert winding.against == 0 and not winding.inward
    assert winding.volume == pytest.approx(trimesh.Trimesh(vertices, faces).volume)


def test_a_ball_wound_inward_has_a_negative_volume(ball):
    vertices, faces = ball
    winding = measure_winding(vertices, faces[:, ::-1])
    assert winding.against == 0 and winding.inward


@pytest.mark.parametrize("share", [0.01, 0.1, 0.4])
def test_flipped_faces_are_counted(ball, share):
    vertices, faces = ball
    flipped = np.random.default_rng(0).choice(len(faces), round(share * len(faces)), replace=False)
    mixed = faces.copy()
    mixed[flipped] = mixed[flipped][:, ::-1]
    assert measure_winding(vertices, mixed).against == pytest.approx(len(flipped) / len(faces))


def test_vertices_at_equal_positions_count_as_one(ball):
    vertices, faces = ball
    soup, triangles = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    triangles[:5] = triangles[:5, ::-1]
    assert measure_winding(soup, triangles).against == pytest.approx(5 / len(faces))


def test_each_piece_has_its_own_majority(ball):
    vertices, faces = ball
    two = np.concatenate([vertices, vertices + 5])
    winding = measure_winding(two, np.concatenate([faces, faces[:, ::-1] + len(vertices)]))
    assert winding.against == 0 and winding.volume != 0


def test_an_open_mesh_and_an_edge_of_three_faces(ball):
    vertices, faces = ball
    assert measure_winding(vertices, faces[:-40]).volume > 0
    fan = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0.0]])
    assert measure_winding(fan, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])).against == 0
    assert measure_winding(fan, np.array([[0, 1, 2], [0, 1, 3]])).against == 0.5
