"""The virtual scanner: even sampling, correct side, truth beside the points, and the flaws of the raw preset."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from avatar.checks import AvatarError
from avatar.data.scanner import (
    SCANNERS,
    DressedSurface,
    ScanConfig,
    frame_seed,
    keep_points,
    merge_contacts,
    scan_mesh,
    scan_points,
)
from avatar.records import Scan


def sphere(subdivisions=4, radius=1.0):
    """Vertices and outward faces of a sphere."""
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return torch.from_numpy(np.array(mesh.vertices, np.float32)), torch.from_numpy(np.array(mesh.faces, np.int64))


def box():
    """Vertices and outward faces of a cube with sides of one metre."""
    cube = trimesh.creation.box((1, 1, 1))
    return np.array(cube.vertices, np.float32), np.array(cube.faces, np.int64)


def surface_of(vertices, faces, **changes):
    """A surface that is seen whole, all skin, at rest where it is."""
    parts = {
        "vertices": vertices,
        "canonical": vertices,
        "faces": faces,
        "visible": torch.ones(len(faces), dtype=torch.bool),
        "labels": torch.zeros(len(vertices), dtype=torch.uint8),
    }
    return DressedSurface(**{**parts, **changes})


@pytest.fixture
def ball():
    return surface_of(*sphere())


def test_a_sphere_is_sampled_evenly_with_radial_normals(ball):
    scan = scan_points(ball, ScanConfig(points=20_000), "a.0")
    radius = np.linalg.norm(scan.points, axis=1)
    assert scan.points.shape == scan.normals.shape == (20_000, 3)
    assert (np.abs(radius - 1) < 0.01).all()
    assert ((scan.normals * scan.points).sum(axis=1) / radius > 0.999).all()
    octants = np.bincount((scan.points > 0) @ [1, 2, 4], minlength=8)
    assert np.abs(octants / 2500 - 1).max() < 0.06
    assert scan.points.dtype == scan.normals.dtype == np.float32


def test_only_visible_faces_are_scanned_with_the_normals_of_the_whole(ball):
    top = ball.vertices[ball.faces].mean(dim=1)[:, 1] > 0.3
    scan = scan_points(surface_of(ball.vertices, ball.faces, visible=top), ScanConfig(points=5000), "a.0")
    assert scan.points[:, 1].min() > 0.2
    cube = surface_of(*(torch.from_numpy(np.array(part)) for part in box()))
    lid = (cube.vertices[cube.faces][:, :, 1] > 0).all(dim=1)
    scan = scan_points(surface_of(cube.vertices, cube.faces, visible=lid), ScanConfig(points=5000), "a.0")
    np.testing.assert_allclose(scan.points[:, 1], 0.5, atol=1e-6)
    corner = np.abs(scan.points[:, [0, 2]]).min(axis=1) > 0.45
    assert np.abs(scan.normals[corner, 0]).min() > 0.3  # smooth over the rim of what is visible
    hidden = surface_of(ball.vertices, ball.faces, visible=torch.zeros(len(ball.faces), dtype=torch.bool))
    with pytest.raises(AvatarError, match=r"some visible faces in a\.0"):
        scan_points(hidden, ScanConfig(), "a.0")


def test_truth_stays_beside_the_points(ball):
    canonical = 2 * ball.vertices + torch.tensor([0.0, 1.0, 0.0])
    labels = (ball.vertices[:, 0] > 0).to(torch.uint8)
    surface = surface_of(ball.vertices, ball.faces, canonical=canonical, labels=labels)
    scan = scan_points(surface, ScanConfig(points=3000), "a.0")
    np.testing.assert_allclose(scan.canonical, 2 * scan.points + [0, 1, 0], atol=1e-5)
    clear = np.abs(scan.points[:, 0]) > 0.1
    np.testing.assert_array_equal(scan.labels[clear], scan.points[clear, 0] > 0)


def test_a_scan_depends_on_seed_and_name_alone(ball):
    config = ScanConfig(points=500, noise=0.001, holes=2, merge=0.01)
    first, again = scan_points(ball, config, "a.0"), scan_points(ball, config, "a.0")
    for name in ("points", "normals", "labels", "canonical"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    for other in (scan_points(ball, config, "a.1"), scan_points(ball, ScanConfig(points=500, seed=1), "a.0")):
        assert other.points.shape != first.points.shape or (other.points != first.points).all()
    assert frame_seed(0, "a.0") == 937011399715165635


def test_noise_has_the_size_asked_for(ball):
    clean = scan_points(ball, ScanConfig(points=8000), "a.0")
    noisy = scan_points(ball, ScanConfig(points=8000, noise=0.003), "a.0")
    shake = noisy.points - clean.points
    assert shake.std() == pytest.approx(0.003, rel=0.03)
    assert abs(shake.mean()) < 1e-4
    np.testing.assert_array_equal(noisy.canonical, clean.canonical)


def test_holes_are_round_and_nothing_else_is_lost(ball):
    count = 2000
    whole = scan_points(ball, ScanConfig(points=count), "a.0")
    holed = scan_points(ball, ScanConfig(points=count, holes=3, hole_radius=0.3), "a.0")
    kept = (whole.points[:, None] == holed.points[None]).all(axis=-1).any(axis=1)
    assert kept.sum() == len(holed.points)
    cap = count * 0.3**2 / 4  # a cap of chord r holds r^2 / 4 of a sphere
    assert 0.8 * cap < count - kept.sum() < 3 * cap * 1.3
    assert holed.labels.shape == holed.points.shape[:1]
    with pytest.raises(AvatarError, match="took them all"):
        scan_points(surface_of(*sphere(2, 0.1)), ScanConfig(points=100, holes=1, hole_radius=0.5), "a.0")


def test_sheets_that_face_each_other_run_into_one():
    """Two planes 8 mm apart facing each other meet halfway; back to back, or far apart, they stay."""
    grid = np.stack(np.meshgrid(np.arange(40) * 0.004, np.arange(40) * 0.004), axis=-1).reshape(-1, 2)

    def planes(gap, lower):
        points = np.concatenate([np.c_[grid, np.zeros(1600)], np.c_[grid, np.full(1600, gap)]])
        normals = np.concatenate([np.tile([0.0, 0, lower], (1600, 1)), np.tile([0.0, 0, -lower], (1600, 1))])
        return Scan(points, normals)

    facing = merge_contacts(planes(0.008, 1.0), 0.012)
    np.testing.assert_allclose(facing.points[:, 2], 0.004, atol=1e-9)
    for apart in (planes(0.008, -1.0), planes(0.05, 1.0)):
        np.testing.assert_array_equal(merge_contacts(apart, 0.012).points, apart.points)


def test_the_mesh_has_the_visible_faces_and_no_other_vertices(ball):
    top = ball.vertices[ball.faces].mean(dim=1)[:, 1] > 0.3
    scan = scan_mesh(surface_of(ball.vertices, ball.faces, visible=top))
    assert len(scan.faces) == int(top.sum())
    assert set(scan.faces.ravel()) == set(range(len(scan.points)))
    np.testing.assert_array_equal(scan.points[scan.faces], ball.vertices[ball.faces[top]].numpy())
    np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1, atol=1e-5)


def test_kept_points_take_all_that_is_known_and_their_faces_along():
    points = np.arange(15.0).reshape(5, 3)
    faces = np.array([[0, 1, 2], [2, 3, 4], [0, 3, 4]])
    whole = Scan(points, -points, faces, np.arange(5), points + 1, points / 20)
    some = keep_points(whole, np.array([True, False, True, True, True]))
    np.testing.assert_array_equal(some.points[some.faces], points[faces[1:]])
    np.testing.assert_array_equal(some.labels, [0, 2, 3, 4])
    np.testing.assert_array_equal(some.canonical, some.points + 1)
    np.testing.assert_array_equal(some.colors, some.points / 20)
    assert keep_points(Scan(points, -points), np.ones(5, bool)).faces is None


def test_presets_and_ranges():
    assert SCANNERS["perfect"] == ScanConfig()
    assert SCANNERS["raw"].noise == 0.0015
    assert replace(SCANNERS["raw_mesh"], mesh=False) == SCANNERS["raw"]
    for bad in ({"points": 0}, {"edge": 0.0}, {"noise": -1}, {"noise": 2.0}, {"holes": -1}, {"merge": float("nan")}):
        with pytest.raises(AvatarError, match="expected"):
            ScanConfig(**bad)
