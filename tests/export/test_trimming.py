"""Trimming to what points support, cutting along a line, dropping small parts: closed forms on a flat grid."""

import numpy as np
import pytest

from avatar.export.meshing import cut_surface, drop_small_parts, trim_surface
from avatar.records import Mesh, PointCloud


def grid(size=11):
    """A unit square in the xy plane, facing +z."""
    x, y = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size), indexing="xy")
    ids = np.arange(size * size).reshape(size, size)
    a, b, c, d = ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return Mesh(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), faces)


def crosses(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def area(mesh):
    return np.linalg.norm(crosses(mesh), axis=1).sum() / 2


def trimmed(covered, max_hole=0.1, min_part=0.01):
    """The unit square, cut to points 1 cm apart where ``covered(x, y)``."""
    x, y = (np.arange(100) + 0.5) / 100, (np.arange(100) + 0.5) / 100
    x, y = (values.reshape(-1) for values in np.meshgrid(x, y))
    points = np.stack([x, y, 0 * x], axis=1)[covered(x, y)]
    return trim_surface(grid(101), PointCloud(points, np.tile([0, 0, 1.0], (len(points), 1))), max_hole, min_part)


def test_trimming_ends_the_surface_where_the_points_end():
    half = trimmed(lambda x, y: x < 0.4)
    assert half.vertices[:, 0].max() == pytest.approx(0.4, abs=0.01)
    assert area(half) == pytest.approx(0.4, abs=0.01)
    assert (crosses(half)[:, 2] > 0).all()
    whole = trimmed(lambda x, y: x < 2)
    assert area(whole) == pytest.approx(1, abs=1e-9)  # the border of the mesh is no rim to cut along
    sparse = trimmed(lambda x, y: (x < 0.4) & (np.floor(100 * x) % 3 == 0) & (np.floor(100 * y) % 3 == 0), max_hole=0)
    assert area(sparse) == pytest.approx(0.4, abs=0.03)  # wider gaps than max_hole, but nothing else is there


def test_trimming_opens_gaps_wider_than_the_largest_hole():
    def gap(x, y):
        return np.hypot(x - 0.5, y - 0.5) > 0.1

    assert area(trimmed(gap, max_hole=0.25)) == pytest.approx(1, abs=1e-9)
    opened = trimmed(gap, max_hole=0.05)
    assert area(opened) == pytest.approx(1 - np.pi * 0.1**2, abs=0.006)
    inside = np.hypot(*(opened.vertices[:, :2] - 0.5).T)
    assert inside.min() == pytest.approx(0.1, abs=0.015)


def test_trimming_goes_by_the_distance_along_the_surface_and_to_it():
    """A surface that runs 2 cm beside its points is theirs; one half a metre away, with no rim in sight, is not."""
    x, y = (values.reshape(-1) for values in np.meshgrid(*[(np.arange(100) + 0.5) / 100] * 2))
    cloud = PointCloud(np.stack([x, y, 0 * x], axis=1), np.tile([0, 0, 1.0], (len(x), 1)))
    for height, kept in ((0.02, 1), (0.5, 0)):
        raised = Mesh(grid(101).vertices + [0, 0, height], grid(101).faces)
        assert area(trim_surface(raised, cloud, 0.1, 0.01)) == pytest.approx(kept, abs=1e-9)


def test_trimming_drops_parts_below_the_smallest_share():
    def islands(x, y):
        return (x < 0.6) | ((x > 0.8) & (y < 0.2))

    assert area(trimmed(islands, min_part=0.01)) == pytest.approx(0.6 + 0.04, abs=0.015)
    alone = trimmed(islands, min_part=0.1)
    assert area(alone) == pytest.approx(0.6, abs=0.01) and alone.vertices[:, 0].max() < 0.62


@pytest.mark.parametrize(("slope", "offset"), [((1, 0), 0.33), ((0.6, 0.8), 0.71), ((-0.3, 1), 0.25)])
def test_a_linear_cut_leaves_the_exact_half(slope, offset):
    mesh = grid()
    values = mesh.vertices[:, :2] @ slope - offset
    kept, lost = cut_surface(mesh, values), cut_surface(mesh, -values)
    assert (kept.vertices[:, :2] @ slope <= offset + 1e-12).all()
    assert (crosses(kept)[:, 2] > -1e-12).all()  # still facing +z
    assert crosses(kept)[:, 2].sum() / 2 + crosses(lost)[:, 2].sum() / 2 == pytest.approx(1)
    if slope == (1, 0):
        assert crosses(kept)[:, 2].sum() / 2 == pytest.approx(offset)
    edges, used = np.unique(
        np.sort(kept.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True
    )
    rim = kept.vertices[edges[used == 1].reshape(-1), :2]
    on_border = (np.abs(rim - 0.5) > 0.5 - 1e-12).any(axis=1)
    assert (on_border | (np.abs(rim @ slope - offset) < 1e-12)).all()  # no seams inside


def test_all_or_nothing():
    mesh = grid()
    whole = cut_surface(mesh, np.full(len(mesh.vertices), -1.0))
    np.testing.assert_array_equal(whole.vertices[whole.faces], mesh.vertices[mesh.faces])
    assert not len(cut_surface(mesh, np.ones(len(mesh.vertices))).faces)


def test_small_parts_go_by_area_not_by_triangle_count():
    large = Mesh(np.array([[0, 0, 5.0], [9, 0, 5], [0, 9, 5]]), np.array([[0, 1, 2]]))
    small = grid()
    both = Mesh(np.concatenate([small.vertices, large.vertices]), np.concatenate([small.faces, large.faces + 121]))
    kept = drop_small_parts(both, 0.1)
    np.testing.assert_array_equal(kept.vertices, large.vertices)
    np.testing.assert_array_equal(kept.faces, large.faces)
    assert len(drop_small_parts(both, 0.001).faces) == 201
