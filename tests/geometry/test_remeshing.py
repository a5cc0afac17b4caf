"""Remeshing: even triangles, the same surface, the same borders."""

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError
from avatar.geometry.laplacians import boundary_edges, mesh_parts
from avatar.geometry.remeshing import cut_at_level, even_triangles, manifold_faults, smooth_borders
from avatar.records import Mesh

pytest.importorskip("pyacvd")


def as_mesh(solid) -> Mesh:
    return Mesh(np.asarray(solid.vertices, np.float64), np.asarray(solid.faces, np.int64))


def closed_tube() -> Mesh:
    """A tube of radius 0.2 from -0.4 to 0.4 with lids, of triangles about 3 cm long."""
    solid = trimesh.creation.cylinder(0.2, 0.8, sections=64).subdivide_to_size(0.03)
    return Mesh(np.asarray(solid.vertices)[:, [1, 2, 0]], np.asarray(solid.faces, np.int64))


def open_tube(edge: float) -> Mesh:
    """The tube between -0.3 and 0.3, of even triangles."""
    whole = closed_tube()
    part = cut_at_level(whole.vertices, whole.faces, -np.abs(whole.vertices[:, 1]), -0.3)
    return even_triangles(part, whole, edge)


def edge_lengths(mesh: Mesh) -> np.ndarray:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).edges_unique_length


def quality(mesh: Mesh) -> np.ndarray:
    """One for equilateral triangles, zero for flat ones."""
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return 4 * np.sqrt(3) * areas / np.square(corners - np.roll(corners, -1, axis=1)).sum(axis=(1, 2))


@pytest.mark.parametrize("edge", [0.04, 0.12])
def test_a_sphere_stays_a_sphere_of_even_triangles(edge):
    sphere = as_mesh(trimesh.creation.icosphere(4, 0.3))
    made = even_triangles(sphere, sphere, edge)
    solid = trimesh.Trimesh(made.vertices, made.faces, process=False)
    assert solid.is_watertight and solid.euler_number == 2 and solid.volume > 0
    assert np.linalg.norm(made.vertices, axis=1) == pytest.approx(0.3, abs=0.003)
    lengths = edge_lengths(made)
    assert np.median(lengths) == pytest.approx(edge, rel=0.1) and lengths.max() < 1.6 * edge
    assert np.quantile(quality(made), 0.01) > 0.6


def test_borders_of_a_tube_stay_where_they_are():
    made = open_tube(0.04)
    solid = trimesh.Trimesh(made.vertices, made.faces, process=False)
    assert solid.euler_number == 0 and solid.is_winding_consistent and not manifold_faults(made.faces)
    border = np.unique(boundary_edges(made.faces))
    assert np.abs(np.abs(made.vertices[border, 1]) - 0.3).max() < 1e-3
    assert np.linalg.norm(made.vertices[:, [0, 2]], axis=1) == pytest.approx(0.2, abs=0.004)
    assert np.quantile(quality(made), 0.01) > 0.6 and edge_lengths(made).max() < 1.6 * 0.04
    assert (solid.face_normals * solid.triangles_center * [1, 0, 1]).sum(axis=1).min() > 0  # none is turned over


def test_a_strap_narrower_than_an_edge_is_kept():
    """Two plates joined by a strap of 14 mm, on a plane, edges of 18 mm."""
    plane = trimesh.creation.box((0.3, 0.3, 0.01)).subdivide_to_size(0.008)
    whole = as_mesh(plane)
    x, y, z = whole.vertices.T
    inside = np.maximum(np.abs(y) - 0.04, 0.007 - np.abs(x))
    part = cut_at_level(whole.vertices, whole.faces, np.minimum(np.minimum(inside, z), 0.13 - np.abs(y)), 0.0)
    made = even_triangles(part, whole, 0.018)
    assert len(np.unique(mesh_parts(made.faces, len(made.vertices)))) == 1 and not manifold_faults(made.faces)


def test_other_sheets_of_the_surface_do_not_come_along():
    """The upper of two plates 6 mm apart, with edges of 40 mm."""
    low, high = (trimesh.creation.box((0.3, 0.3, 0.002)).subdivide_to_size(0.02) for _ in range(2))
    high.apply_translation([0, 0, 0.008])
    whole = as_mesh(trimesh.util.concatenate([low, high]))
    part = cut_at_level(whole.vertices, whole.faces, np.where(whole.vertices[:, 2] > 0.008, 0.1, -0.1), 0.0)
    made = even_triangles(part, whole, 0.04)
    assert len(np.unique(mesh_parts(made.faces, len(made.vertices)))) == 1 and made.vertices[:, 2].min() > 0.006


def test_remeshing_depends_on_nothing_but_the_mesh():
    first, second = (open_tube(0.05) for _ in range(2))
    assert (first.vertices == second.vertices).all() and (first.faces == second.faces).all()
    with pytest.raises(AvatarError, match="edge"):
        open_tube(0.0)


def test_faults_of_a_manifold_are_counted():
    fan = np.array([[0, 1, 2], [0, 2, 3]])
    assert manifold_faults(fan) == 0
    assert manifold_faults(np.concatenate([fan, [[0, 2, 4]]])) > 0  # an edge of three faces
    assert manifold_faults(np.array([[0, 1, 2], [0, 3, 2]])) > 0  # one is turned over
    assert manifold_faults(np.array([[0, 1, 2], [0, 3, 4]])) == 1  # joined at a vertex alone


def test_a_cut_is_where_the_value_is():
    sphere = as_mesh(trimesh.creation.icosphere(4, 0.3))
    part = cut_at_level(sphere.vertices, sphere.faces, sphere.vertices[:, 1], 0.1)
    border = np.unique(boundary_edges(part.faces))
    assert part.vertices[border, 1] == pytest.approx(0.1, abs=1e-3) and part.vertices[:, 1].min() > 0.099
    solid = trimesh.Trimesh(part.vertices, part.faces, process=False)
    assert solid.area == pytest.approx(2 * np.pi * 0.3 * 0.2, rel=0.01) and solid.is_winding_consistent
    assert not len(cut_at_level(sphere.vertices, sphere.faces, sphere.vertices[:, 1], 1.0).faces)
    assert len(cut_at_level(sphere.vertices, sphere.faces, sphere.vertices[:, 1], -1.0).faces) == len(sphere.faces)


def test_smooth_borders_lose_their_teeth_and_keep_their_size():
    mesh = open_tube(0.03)
    border = np.unique(boundary_edges(mesh.faces))
    top = border[mesh.vertices[border, 1] > 0]
    ragged = mesh.vertices.copy()
    along = np.arctan2(ragged[top, 2], ragged[top, 0]).argsort()
    ragged[top[along], 1] += 0.01 * (-1.0) ** np.arange(len(top))
    smooth = smooth_borders(ragged, mesh.faces, 10)
    assert smooth[top, 1].std() < 0.2 * ragged[top, 1].std()
    assert np.linalg.norm(smooth[top][:, [0, 2]], axis=1).mean() == pytest.approx(0.2, rel=0.02)
    inner = np.setdiff1d(np.arange(len(ragged)), border)
    assert (smooth[inner] == ragged[inner]).all()
