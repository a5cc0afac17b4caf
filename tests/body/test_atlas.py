"""The open body's atlas: MakeHuman's own where MakeHuman has the triangle, discs without folds elsewhere."""

import numpy as np
import pytest

from avatar.body.open import flatten_disc, number_corners, open_body, patches_without_uv, quad_corners, toeless_atlas
from avatar.checks import AvatarError

QUADS = np.array([[0, 1, 2, 3], [1, 4, 5, 2]])
QUAD_UV = np.array([[0, 1, 2, 3], [6, 4, 5, 7]])  # cut along the edge 1-2


def fan(rings: int = 3, around: int = 8) -> np.ndarray:
    """Triangles of a disc of concentric rings about vertex 0, turning counter-clockwise."""
    faces = [[0, 1 + i, 1 + (i + 1) % around] for i in range(around)]
    for ring in range(rings - 1):
        inner, outer = 1 + ring * around, 1 + (ring + 1) * around
        for i in range(around):
            j = (i + 1) % around
            faces += [[inner + i, outer + i, outer + j], [inner + i, outer + j, inner + j]]
    return np.array(faces)


def areas(places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (places[faces[:, i]] for i in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def test_stored_atlas_is_what_anny_gives():
    template = open_body().template
    uv, uv_faces = toeless_atlas(template.faces.numpy())
    assert np.array_equal(uv_faces, template.uv_faces.numpy())
    np.testing.assert_allclose(uv, template.uv.numpy(), atol=0.6 / 65535)


def test_halves_of_quads_have_their_corners_and_others_none():
    triangles = np.array([[2, 0, 1], [3, 0, 2], [5, 2, 1], [0, 1, 4]])
    assert quad_corners(triangles, QUADS, QUAD_UV).tolist() == [[2, 0, 1], [3, 0, 2], [5, 7, 6], [-1, -1, -1]]


def test_patches_are_connected_and_in_order_of_x():
    faces = np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6], [7, 8, 9]])
    corners = np.array([[-1] * 3, [-1] * 3, [0, 1, 2], [-1] * 3])
    vertices = np.zeros((10, 3))
    vertices[7:, 0] = -1
    masks = patches_without_uv(faces, corners, vertices)
    assert [np.flatnonzero(mask).tolist() for mask in masks] == [[3], [0, 1]]


def test_disc_has_its_border_on_the_circle_and_no_fold():
    faces = fan() + 5
    ids, places = flatten_disc(faces)
    assert ids.tolist() == list(range(5, 30))
    np.testing.assert_allclose(np.linalg.norm(places[-8:], axis=1), 1)
    np.testing.assert_allclose(places[0], 0, atol=1e-12)  # the middle vertex, by symmetry
    flat = areas(places, faces - 5)
    assert flat.min() > 0
    assert flat.sum() == pytest.approx(4 * np.sin(np.pi / 4))  # a regular octagon


def test_ring_with_two_borders_is_no_disc():
    with pytest.raises(AvatarError, match="one border"):
        flatten_disc(fan()[8:])


def test_first_corner_of_a_vertex_has_its_number():
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    corners = np.array([[4, 3, 2], [2, 1, 0]])  # vertex 1 is at two places
    coordinates = np.arange(10).reshape(5, 2) / 10
    uv, uv_faces = number_corners(faces, corners, coordinates)
    assert len(uv) == 5
    np.testing.assert_array_equal(uv[uv_faces], coordinates[corners])
    assert (uv_faces == faces).sum() == 5
