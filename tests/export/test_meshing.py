"""Poisson meshing: closed forms, openings that stay open, bad input of every kind, and dying workers."""

import os
import signal
import threading
import time

import numpy as np
import pytest

from avatar.checks import AvatarError, DataError
from avatar.export.meshing import MeshingError, PoissonConfig, PoissonMesher, mesh_folder
from avatar.io.meshes import read_mesh, write_mesh
from avatar.io.points import write_points
from avatar.records import PointCloud

RADIUS = 0.5


def sphere_points(count=6000, seed=0):
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(normals * RADIUS, normals)


def tube_points(count=12000, height=1.0, seed=0):
    generator = np.random.default_rng(seed)
    angle, up = generator.uniform(0, 2 * np.pi, count), generator.uniform(-height / 2, height / 2, count)
    normals = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], axis=1)
    return PointCloud(normals * 0.15 + np.stack([0 * up, up, 0 * up], axis=1), normals)


@pytest.fixture(scope="module")
def mesher():
    with PoissonMesher(PoissonConfig(depth=6)) as mesher:
        yield mesher


def edge_use(mesh):
    """Edges with the number of triangles that share each."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


def test_a_sphere_comes_back_round_closed_and_outside_out(mesher):
    mesh = mesher.mesh(sphere_points())
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), RADIUS, atol=0.006)
    _, used = edge_use(mesh)
    assert (used == 2).all()
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)


def test_both_ends_of_a_tube_stay_open_with_clean_rims(mesher):
    mesh = mesher.mesh(tube_points())
    edges, used = edge_use(mesh)
    assert set(used) == {1, 2}
    rim = mesh.vertices[edges[used == 1]]
    np.testing.assert_allclose(np.abs(rim[..., 1]), 0.5, atol=0.012)  # cut where the points end
    assert (rim[..., 1] > 0).any() and (rim[..., 1] < 0).any()
    np.testing.assert_allclose(np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2]), 0.15, atol=0.01)
    lengths = np.linalg.norm(rim[:, 0] - rim[:, 1], axis=1).sum()
    assert lengths == pytest.approx(2 * 2 * np.pi * 0.15, rel=0.25)  # two circles, no teeth


@pytest.mark.parametrize(("width", "open_ends"), [(0.02, 0), (0.16, 2)])
def test_small_gaps_are_closed_and_wide_ones_opened(mesher, width, open_ends):
    cloud = tube_points()
    beside = np.hypot(cloud.points[:, 1], cloud.points[:, 2]) > width / 2
    kept = beside | (cloud.points[:, 0] < 0)
    mesh = mesher.mesh(PointCloud(cloud.points[kept], cloud.normals[kept]))
    edges, used = edge_use(mesh)
    rim = mesh.vertices[edges[used == 1].reshape(-1)]
    inner = np.abs(rim[:, 1]) < 0.3
    assert inner.any() == bool(open_ends)
    if open_ends:
        reach = np.hypot(rim[inner, 1], rim[inner, 2])
        np.testing.assert_allclose(reach, width / 2, atol=0.03)


def test_a_jump_in_density_is_no_rim(mesher):
    cloud = tube_points(30000)
    thinned = (cloud.points[:, 1] < 0) | (np.arange(len(cloud.points)) % 8 == 0)
    mesh = mesher.mesh(PointCloud(cloud.points[thinned], cloud.normals[thinned]))
    edges, used = edge_use(mesh)
    assert (np.abs(mesh.vertices[edges[used == 1]][..., 1]) > 0.45).all()


def test_a_finger_thinner_than_the_points_neighbourhoods_stays_whole(mesher):
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(300, 3))
    shaft = np.arange(300) < 260  # the others lie on the two round tips
    normals[shaft, 1] = 0
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    along = np.where(shaft, generator.uniform(0, 0.2, 300), np.where(normals[:, 1] > 0, 0.2, 0.0))
    mesh = mesher.mesh(PointCloud(0.008 * normals + np.stack([0 * along, along, 0 * along], axis=1), normals))
    _, used = edge_use(mesh)
    assert (used == 2).all()
    assert mesh.vertices[:, 1].max() > 0.203 and mesh.vertices[:, 1].min() < -0.003


def test_the_same_cloud_gives_the_same_bytes_in_another_worker(mesher, tmp_path):
    with PoissonMesher(PoissonConfig(depth=6)) as other:
        for name, one in (("a", mesher), ("b", other)):
            write_mesh(tmp_path / f"{name}.ply", one.mesh(sphere_points()))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def spoiled(points=None, normals=None):
    cloud = sphere_points()
    return PointCloud(cloud.points if points is None else points, cloud.normals if normals is None else normals)


def with_value(array, value):
    changed = array.copy()
    changed[7, 1] = value
    return changed


GOOD = sphere_points()
BAD_CLOUDS = {
    "points: expected finite": spoiled(points=with_value(GOOD.points, np.nan)),
    "finite numbers, got 1": spoiled(points=with_value(GOOD.points, np.inf)),
    "normals: expected finite": spoiled(normals=with_value(GOOD.normals, np.nan)),
    "got 1\\.": PointCloud(GOOD.points[:1], GOOD.normals[:1]),
    "at least 100": PointCloud(GOOD.points[:99], GOOD.normals[:99]),
    "different ones, got 1\\.": spoiled(points=np.ones_like(GOOD.points)),
    "length zero": spoiled(normals=np.zeros_like(GOOD.normals)),
    "from end to end": spoiled(points=GOOD.points * 1e30),
    "end to end, got 1e-05": spoiled(points=GOOD.points * 1e-5),
    "expected shape": PointCloud(GOOD.points, GOOD.normals[:-1]),
    "no points|at least 100 different ones, got 0": PointCloud(GOOD.points[:0], GOOD.normals[:0]),
    "at most max_points": PointCloud(np.zeros((1_000_001, 3)), np.zeros((1_000_001, 3))),
}


@pytest.mark.parametrize("reason", BAD_CLOUDS)
def test_bad_clouds_give_a_typed_error_and_never_reach_the_worker(mesher, reason):
    before = mesher.worker_pid
    with pytest.raises(MeshingError, match=reason):
        mesher.mesh(BAD_CLOUDS[reason])
    assert mesher.worker_pid == before


def test_points_that_support_nothing_are_refused(mesher):
    generator = np.random.default_rng(0)
    crumbs = generator.uniform(0, 10, (40, 1, 3)) + generator.uniform(0, 1e-3, (40, 20, 3))
    normals = np.tile([0, 1.0, 0], (800, 1))
    with pytest.raises(MeshingError, match="no part of the reconstructed surface"):
        mesher.mesh(PointCloud(crumbs.reshape(-1, 3), normals))


@pytest.mark.parametrize("kind", ["line", "plane", "two values", "random normals", "outlier"])
def test_degenerate_clouds_give_a_mesh_or_a_typed_error(mesher, kind):
    generator = np.random.default_rng(0)
    points, normals = generator.normal(size=(400, 3)), generator.normal(size=(400, 3))
    match kind:
        case "line":
            points[:, 1:] = 0
        case "plane":
            points[:, 1], normals = 0, np.tile([0, 1.0, 0], (400, 1))
        case "two values":
            points = np.sign(points) + 1e-4 * generator.normal(size=(400, 3))
        case "outlier":
            points[0] = 900
    try:
        mesh = mesher.mesh(PointCloud(points, normals))
    except MeshingError:
        return
    assert len(mesh.faces) and np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)


def test_a_worker_killed_during_a_job_is_one_failed_cloud():
    with PoissonMesher(PoissonConfig(depth=9)) as mesher:
        mesher.mesh(tube_points(2000))
        victim = mesher.worker_pid

        def kill():
            time.sleep(0.3)
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        with pytest.raises(MeshingError, match="died"):
            mesher.mesh(sphere_points(20000))  # takes seconds
        killer.join()
        mesher.config.depth = 6
        assert len(mesher.mesh(sphere_points()).faces)
        assert mesher.worker_pid != victim


def test_a_worker_that_does_not_listen_is_ended(monkeypatch):
    monkeypatch.setattr("avatar.export.meshing.GRACE_S", 0.2)
    with PoissonMesher(PoissonConfig(depth=5, max_hole=0.1)) as mesher:
        mesher.mesh(GOOD)
        mesher.config.timeout_s = 0.3
        os.kill(mesher.worker_pid, signal.SIGSTOP)
        started = time.monotonic()
        with pytest.raises(MeshingError, match="died"):
            mesher.mesh(GOOD)
        assert time.monotonic() - started < 10
        mesher.config.timeout_s = 60.0
        assert len(mesher.mesh(GOOD).faces)


def test_a_job_that_takes_too_long_is_ended():
    with PoissonMesher(PoissonConfig(depth=6)) as mesher:
        mesher.mesh(sphere_points())
        slow = mesher.worker_pid
        mesher.config.timeout_s, mesher.config.depth = 0.05, 9
        started = time.monotonic()
        with pytest.raises(MeshingError, match="timeout_s"):
            mesher.mesh(sphere_points(20000))
        assert time.monotonic() - started < 2
        with pytest.raises(ProcessLookupError):
            os.kill(slow, 0)


@pytest.mark.parametrize("wrong", [{"depth": 0}, {"depth": 20}, {"timeout_s": 0}, {"max_hole": -1}, {"min_part": 2}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(AvatarError, match=next(iter(wrong))):
        PoissonConfig(**wrong)


def test_a_folder_is_meshed_resumed_and_failures_are_listed(tmp_path):
    clouds, meshes = tmp_path / "predictions", tmp_path / "meshes"
    for name in ("walk.0001", "walk.0002"):
        write_points(clouds / f"{name}.ply", sphere_points())
    write_points(clouds / "walk.0003.ply", PointCloud(GOOD.points[:50], GOOD.normals[:50]))
    (clouds / "walk.0004.ply").write_bytes(b"ply broken")
    config = PoissonConfig(depth=5, max_hole=0.1)
    first = mesh_folder(clouds, meshes, ("ply", "glb"), config=config)
    assert first.done == ("walk.0001", "walk.0002") and not first.skipped
    assert set(first.failed) == {"walk.0003", "walk.0004"}
    assert "at least 100" in first.failed["walk.0003"] and "walk.0004.ply" in first.failed["walk.0004"]
    assert {path.name for path in meshes.glob("[!.]*")} == {f"walk.000{i}.{e}" for i in (1, 2) for e in ("ply", "glb")}

    (meshes / "walk.0002.glb").write_bytes(b"half")
    second = mesh_folder(clouds, meshes, ("ply", "glb"), frames=["walk.0001", "walk.0002"], config=config)
    assert second.skipped == ("walk.0001",) and second.done == ("walk.0002",)
    assert len(read_mesh(meshes / "walk.0002.glb").faces)

    with pytest.raises(DataError, match=r"run\.0001"):
        mesh_folder(clouds, meshes, frames=["run.0001"])
    with pytest.raises(DataError, match="no point clouds"):
        mesh_folder(meshes / "nothing", meshes)
    with pytest.raises(AvatarError, match="formats"):
        mesh_folder(clouds, meshes, ("ply", "zip"))
