"""Raw meshes: fine edges without gaps, contacts joined into one sheet with the truth kept, smooth noise, holes."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from avatar.data.scanner import (
    DressedSurface,
    Pattern,
    ScanConfig,
    boundary_partners,
    fuse_mesh,
    fused_noise,
    scan_mesh,
    split_faces,
    split_long_edges,
    weld_contacts,
)
from avatar.records import Scan


def surface_of(mesh, visible=None, labels=None, canonical=None):
    """A trimesh as a dressed surface, seen whole and at rest where it is."""
    vertices, faces = torch.from_numpy(np.array(mesh.vertices, np.float32)), torch.from_numpy(np.array(mesh.faces))
    return DressedSurface(
        vertices=vertices,
        canonical=vertices if canonical is None else torch.from_numpy(canonical.astype(np.float32)),
        faces=faces.long(),
        visible=torch.ones(len(faces), dtype=torch.bool) if visible is None else torch.from_numpy(visible),
        labels=torch.zeros(len(vertices), dtype=torch.uint8) if labels is None else torch.from_numpy(labels),
    )


def sheet(height, facing, shift=0.0):
    """A level square sheet of 20 cm with edges of 1 cm, facing up (1) or down (-1)."""
    side = 21
    x, z = np.meshgrid(np.arange(side) * 0.01, np.arange(side) * 0.01, indexing="ij")
    points = np.stack([x.ravel() + shift, np.full(side**2, height), z.ravel()], axis=1).astype(np.float32)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 1, corner + side + 1], 1),
                            np.stack([corner, corner + side + 1, corner + side], 1)])  # fmt: skip
    return points, faces if facing > 0 else faces[:, ::-1]


def two_sheets(gap, shift=0.0, lower=1, upper=-1):
    """Two sheets one above the other, with other places at rest and labels 1 and 2."""
    (below, down), (above, up) = sheet(0.0, lower), sheet(gap, upper, shift)
    points = np.concatenate([below, above])
    normals = np.zeros_like(points)
    normals[:, 1] = np.repeat([lower, upper], [len(below), len(above)])
    labels = np.repeat([1, 2], [len(below), len(above)]).astype(np.uint8)
    canonical = points + np.repeat([[0, 0, 0], [1, 0, 0]], [len(below), len(above)], axis=0).astype(np.float32)
    return Scan(points, normals, np.concatenate([down, up + len(below)]), labels, canonical)


def pieces(scan):
    """Number of pieces that hang together at vertices."""
    ends = scan.faces.reshape(-1), np.roll(scan.faces, 1, axis=1).reshape(-1)
    count = len(scan.points)
    return connected_components(coo_matrix((np.ones(len(ends[0])), ends), shape=(count, count)), directed=False)[0]


def area(points, faces):
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def test_long_edges_are_split_on_both_sides():
    ball = trimesh.creation.icosphere(2)
    rest = 2 * ball.vertices + [0, 1, 0]
    labels = (ball.vertices[:, 0] > 0).astype(np.uint8)
    whole = scan_mesh(surface_of(ball, labels=labels, canonical=rest))
    fine = split_long_edges(whole, 0.1)
    mesh = trimesh.Trimesh(fine.points, fine.faces, process=False)
    assert mesh.edges_unique_length.max() <= 0.1
    assert mesh.is_watertight  # no gap and no T-junction
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(ball.volume, rel=1e-5)  # the surface is the same
    np.testing.assert_allclose(fine.canonical, 2 * fine.points + [0, 1, 0], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(fine.normals, axis=1), 1, atol=1e-5)
    clear = np.abs(fine.points[:, 0]) > 0.4
    np.testing.assert_array_equal(fine.labels[clear], fine.points[clear, 0] > 0)
    assert len(split_long_edges(whole, 10.0).points) == len(whole.points)


@pytest.mark.parametrize("marks", range(8))
def test_a_triangle_is_split_at_any_of_its_edges(marks):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0]])
    middles = np.array([[3 if marks & 1 else -1, 4 if marks & 2 else -1, 5 if marks & 4 else -1]])
    faces = split_faces(np.array([[0, 1, 2]]), middles)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert (areas > 0.1).all()  # wound as before, none without area
    assert areas.sum() == pytest.approx(0.5)
    assert set(faces.ravel()) == {0, 1, 2} | set(middles[middles >= 0])
    assert len(faces) == 1 + bin(marks).count("1")


def two_balls(gap):
    """Two balls side by side, labels 1 and 2, the second a metre farther away at rest."""
    ball = trimesh.creation.icosphere(4, 0.1)
    points = np.concatenate([ball.vertices, ball.vertices + [0.2 + gap, 0, 0]]).astype(np.float32)
    normals = np.tile(ball.vertex_normals, (2, 1)).astype(np.float32)
    labels = np.repeat([1, 2], len(ball.vertices)).astype(np.uint8)
    canonical = points + np.float32([1, 0, 0]) * (labels == 2)[:, None]
    return Scan(points, normals, np.concatenate([ball.faces, ball.faces + len(ball.vertices)]), labels, canonical)


def test_what_touches_becomes_one_sheet_and_the_inside_of_the_contact_goes():
    apart = two_balls(0.004)
    assert pieces(apart) == 2
    joined = weld_contacts(apart, 0.012, np.random.default_rng(0))
    assert pieces(joined) == 1
    aside = np.linalg.norm(joined.points[:, 1:], axis=1)
    between = np.abs(joined.points[:, 0] - 0.102) < 0.01
    reach = np.sqrt(0.1**2 - (0.1 - 0.004) ** 2)  # the gap is 12 mm wide where the balls have curved away by 4 mm each
    assert aside[between].min() > reach - 0.012
    rim = np.abs(joined.points[:, 0] - 0.102) < 1e-3
    assert rim.sum() > 10  # halfway
    assert set(joined.labels[rim]) == {1, 2}  # by lot
    at_rest = joined.canonical[:, 0] > 0.7
    np.testing.assert_array_equal(at_rest, joined.labels == 2)  # label and place at rest are of the same surface
    bridges = np.ptp(joined.labels[joined.faces], axis=1) > 0
    assert bridges.sum() > 10
    for line in (joined.faces[:, [0, 1]], joined.faces[:, [1, 2]], joined.faces[:, [2, 0]]):
        assert (line[:, 0] != line[:, 1]).all()


@pytest.mark.parametrize(("gap", "lower", "upper"), [(0.03, 1, -1), (0.008, -1, 1)])
def test_sheets_apart_or_back_to_back_keep_their_inside(gap, lower, upper):
    apart = two_sheets(gap, lower=lower, upper=upper)
    joined = weld_contacts(apart, 0.012, np.random.default_rng(0))
    middle = np.abs(joined.points[:, [0, 2]] - 0.1).max(axis=1) < 0.05
    assert (np.abs(joined.points[middle, 1, None] - [0, gap]).min(axis=1) < 1e-6).all()
    assert pieces(joined) == (2 if gap > 0.012 else 1)  # the rims of what is near are joined all the same


def test_rims_look_for_another_surface_only():
    near = two_sheets(0.008, lower=-1, upper=1)
    looking, partner = boundary_partners(near, 0.012)
    assert len(looking) == 2 * 80  # the whole border of both
    np.testing.assert_array_equal(near.labels[looking] != near.labels[partner], True)
    np.testing.assert_allclose(np.linalg.norm(near.points[looking] - near.points[partner], axis=1), 0.008, atol=1e-6)
    alike = Scan(near.points, near.normals, near.faces, np.ones_like(near.labels), near.points)
    assert len(boundary_partners(alike, 0.012)[0]) == 0  # neighbours at rest are no other surface
    assert (
        len(boundary_partners(Scan(near.points, near.normals, near.faces, alike.labels, near.canonical), 0.012)[0])
        == 160
    )


def test_noise_has_the_size_asked_for_and_is_alike_at_neighbours():
    ball = trimesh.creation.icosphere(4)
    scan = scan_mesh(surface_of(ball))
    noise = fused_noise(scan, 0.002, np.random.default_rng(0))
    assert noise.std() == pytest.approx(0.002, rel=1e-3)
    assert abs(noise.mean()) < 2e-4
    ends = noise[ball.edges_unique]
    assert np.corrcoef(ends[:, 0].ravel(), ends[:, 1].ravel())[0, 1] > 0.5


def test_a_raw_mesh_is_fine_noisy_holed_and_repeatable():
    ball = trimesh.creation.icosphere(3, 0.3)
    config = ScanConfig(mesh=True, edge=0.03, noise=0.001, holes=2, hole_radius=0.06, merge=0.01)
    first, again = (fuse_mesh(surface_of(ball), config, "a.0") for _ in range(2))
    for name in ("points", "normals", "faces", "labels", "canonical"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert fuse_mesh(surface_of(ball), config, "a.1").points.shape != first.points.shape
    off = np.linalg.norm(first.points, axis=1) - np.linalg.norm(first.canonical, axis=1)
    assert 5e-4 < off.std() < 2e-3
    mesh = trimesh.Trimesh(first.points, first.faces, process=False)
    assert not mesh.is_watertight  # holes
    assert mesh.edges_unique_length.max() < 0.04
    assert set(first.faces.ravel()) == set(range(len(first.points)))
    np.testing.assert_allclose(np.linalg.norm(first.normals, axis=1), 1, atol=1e-5)
    assert ((first.normals * first.points).sum(axis=1) > 0).all()
    perfect = fuse_mesh(surface_of(ball), ScanConfig(mesh=True, edge=0.03), "a.0")
    assert trimesh.Trimesh(perfect.points, perfect.faces, process=False).is_watertight
    assert perfect.colors is None
    assert fuse_mesh(surface_of(ball), ScanConfig(mesh=True, pattern=Pattern.dots), "a.0").colors.shape[1] == 3


def test_an_outfit_is_scanned_as_a_mesh_where_asked(tiny_folder):
    from avatar.data.layouts import OpenOutfit

    outfit = OpenOutfit(tiny_folder, "open", ScanConfig(mesh=True, merge=0.012, noise=0.001))
    scan = outfit.load("train", "rise.00003").scan
    assert scan.faces.max() == len(scan.points) - 1
    assert set(np.unique(scan.labels)) == {0, 1, 2}
    cloth = scan.labels[scan.faces]
    assert (np.ptp(cloth, axis=1) > 0).sum() > 20  # triangles from cloth to skin: the hems are joined
