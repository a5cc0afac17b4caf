"""Remeshing: even triangles, the same surface, the same borders."""

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError
from avatar.geometry.laplacians import boundary_edges
from avatar.geometry.remeshing import cut_at_level, find_edges, isotropic_remesh, smooth_borders, split_long
from avatar.records import Mesh


def as_mesh(solid) -> Mesh:
    return Mesh(np.asarray(solid.vertices, np.float64), np.asarray(solid.faces, np.int64))


def cylinder() -> Mesh:
    """An open tube of radius 0.2 from -0.3 to 0.3 of long thin triangles."""
    turns, heights = np.linspace(0, 2 * np.pi, 96, endpoint=False), np.linspace(-0.3, 0.3, 7)
    ring = np.stack([np.cos(turns), np.zeros(96), np.sin(turns)], axis=1) * 0.2
    vertices = np.concatenate([ring + [0, height, 0] for height in heights])
    start, after = np.arange(96), (np.arange(96) + 1) % 96
    faces = np.concatenate([np.stack([start, start + 96, after], 1), np.stack([after, start + 96, after + 96], 1)])
    return Mesh(vertices, np.concatenate([faces + 96 * i for i in range(6)]))


def edge_lengths(mesh: Mesh) -> np.ndarray:
    ends = find_edges(mesh.faces, len(mesh.vertices)).ends
    return np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)


def quality(mesh: Mesh) -> np.ndarray:
    """One for equilateral triangles, zero for flat ones."""
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return 4 * np.sqrt(3) * areas / np.square(corners - np.roll(corners, -1, axis=1)).sum(axis=(1, 2))


@pytest.mark.parametrize("edge", [0.04, 0.12])
def test_a_sphere_stays_a_sphere_of_even_triangles(edge):
    made = isotropic_remesh(as_mesh(trimesh.creation.icosphere(4, 0.3)), edge)
    solid = trimesh.Trimesh(made.vertices, made.faces, process=False)
    assert solid.is_watertight and solid.euler_number == 2 and solid.volume > 0
    assert np.linalg.norm(made.vertices, axis=1) == pytest.approx(0.3, abs=0.003)
    lengths = edge_lengths(made)
    assert np.median(lengths) == pytest.approx(edge, rel=0.2) and lengths.max() < 1.6 * edge
    assert np.quantile(quality(made), 0.01) > 0.6


def test_borders_of_a_tube_stay_where_they_are():
    made = isotropic_remesh(cylinder(), 0.04)
    solid = trimesh.Trimesh(made.vertices, made.faces, process=False)
    assert solid.euler_number == 0 and solid.is_winding_consistent
    border = np.unique(boundary_edges(made.faces))
    assert np.abs(np.abs(made.vertices[border, 1]) - 0.3).max() < 1e-3
    assert np.linalg.norm(made.vertices[:, [0, 2]], axis=1) == pytest.approx(0.2, abs=0.004)
    assert np.quantile(quality(made), 0.01) > 0.6
    outward = solid.face_normals * solid.triangles_center * [1, 0, 1]
    start = trimesh.Trimesh(cylinder().vertices, cylinder().faces, process=False)
    same = np.sign((start.face_normals * start.triangles_center * [1, 0, 1]).sum())
    assert np.sign(outward.sum(axis=1) * same).min() > 0  # no face is turned over


def test_remeshing_depends_on_nothing_but_the_mesh():
    first, second = (isotropic_remesh(cylinder(), 0.05) for _ in range(2))
    assert (first.vertices == second.vertices).all() and (first.faces == second.faces).all()
    with pytest.raises(AvatarError, match="edge"):
        isotropic_remesh(cylinder(), 0.0)


def test_splitting_keeps_the_area():
    mesh = as_mesh(trimesh.creation.box((0.2, 0.2, 0.2)))
    vertices, faces = split_long(mesh.vertices, mesh.faces, 0.05)
    solid = trimesh.Trimesh(vertices, faces, process=False)
    assert solid.is_watertight and solid.area == pytest.approx(0.24)
    assert edge_lengths(Mesh(vertices, faces)).max() <= 0.05


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
    mesh = isotropic_remesh(cylinder(), 0.03)
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
