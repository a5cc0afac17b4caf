"""USD caches read back by USD itself, and films read back by Pillow."""

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError, DataError
from avatar.export.animation import write_animation, write_usd_meshes, write_usd_points
from avatar.records import Mesh, PointCloud

Usd = pytest.importorskip("pxr.Usd")
UsdGeom = pytest.importorskip("pxr.UsdGeom")


def cloud(count, seed=0):
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud((normals * 0.5).astype(np.float32), normals.astype(np.float32))


def sphere(subdivisions, colored=False):
    solid = trimesh.creation.icosphere(subdivisions)
    colors = np.random.default_rng(0).random((len(solid.vertices), 3)) if colored else None
    return Mesh(np.array(solid.vertices), np.array(solid.faces), colors)


def check_stage(stage, frames, fps):
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == fps
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, frames - 1)
    assert stage.GetDefaultPrim().GetPath() == "/avatar"


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usd"])
def test_points_come_back_frame_by_frame(tmp_path, suffix):
    path = tmp_path / f"walk.points{suffix}"
    clouds = [cloud(200), cloud(300, 1), cloud(250, 2)]
    write_usd_points(path, iter(clouds), 24)
    stage = Usd.Stage.Open(str(path))
    check_stage(stage, 3, 24)
    prim = UsdGeom.Points(stage.GetPrimAtPath("/avatar/points"))
    assert prim.GetNormalsInterpolation() == "vertex"
    for frame, expected in enumerate(clouds):
        np.testing.assert_allclose(np.array(prim.GetPointsAttr().Get(frame)), expected.points, atol=1e-6)
        np.testing.assert_allclose(np.array(prim.GetNormalsAttr().Get(frame)), expected.normals, atol=1e-6)
        widths = np.array(prim.GetWidthsAttr().Get(frame))
        assert len(widths) == len(expected.points) and 0.1 < widths.min() <= widths.max() < 0.6  # spacing is 0.12 m
        low, high = np.array(prim.GetExtentAttr().Get(frame))
        assert (low <= expected.points.min(axis=0)).all() and (high >= expected.points.max(axis=0)).all()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_meshes_may_change_their_triangles(tmp_path):
    meshes = [sphere(1, colored=True), sphere(2, colored=True), sphere(0, colored=True)]
    write_usd_meshes(tmp_path / "a.usdc", meshes, 30.0)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    check_stage(stage, 3, 30)
    prim = UsdGeom.Mesh(stage.GetPrimAtPath("/avatar/mesh"))
    assert prim.GetSubdivisionSchemeAttr().Get() == "none"
    assert prim.GetOrientationAttr().Get() == "rightHanded"
    for frame, mesh in enumerate(meshes):
        np.testing.assert_allclose(np.array(prim.GetPointsAttr().Get(frame)), mesh.vertices, atol=1e-6)
        faces = np.array(prim.GetFaceVertexIndicesAttr().Get(frame)).reshape(-1, 3)
        np.testing.assert_array_equal(faces, mesh.faces)
        assert list(prim.GetFaceVertexCountsAttr().Get(frame)) == [3] * len(mesh.faces)
        np.testing.assert_allclose(np.array(prim.GetDisplayColorPrimvar().Get(frame)), mesh.colors, atol=1e-6)


def test_bad_sequences_leave_nothing_behind(tmp_path):
    bad_points = cloud(9).points.copy()
    bad_points[0] = np.nan
    for action in (
        lambda: write_usd_points(tmp_path / "a.usdc", [], 24),
        lambda: write_usd_points(tmp_path / "a.usdc", [cloud(9)], 0),
        lambda: write_usd_points(tmp_path / "a.usdc", [cloud(9), PointCloud(bad_points, cloud(9).normals)], 24),
        lambda: write_usd_meshes(tmp_path / "a.usdc", [Mesh(sphere(0).vertices, sphere(0).faces + 1)], 24),
        lambda: write_usd_points(tmp_path / "a.abc", [cloud(9)], 24),
    ):
        with pytest.raises(AvatarError):
            action()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("suffix", "tolerance"), [(".webp", 12), (".gif", 2)])
def test_films_keep_frames_order_and_speed(tmp_path, suffix, tolerance):
    from PIL import Image

    colors = [[250, 0, 0], [0, 250, 0], [0, 0, 250]]
    write_animation(tmp_path / f"a{suffix}", [np.full((32, 48, 3), c, np.uint8) for c in colors], fps=20)
    film = Image.open(tmp_path / f"a{suffix}")
    assert film.n_frames == 3 and film.size == (48, 32) and film.info["loop"] == 0
    for frame, color in enumerate(colors):
        film.seek(frame)
        film.load()
        assert film.info["duration"] == 50
        np.testing.assert_allclose(np.asarray(film.convert("RGB"))[16, 24], color, atol=tolerance)


def test_bad_films_are_refused(tmp_path):
    picture = np.zeros((8, 8, 3), np.uint8)
    for images, fps in (([], 10), ([picture, picture[:4]], 10), ([picture], -1)):
        with pytest.raises(AvatarError):
            write_animation(tmp_path / "a.gif", images, fps)
    with pytest.raises(DataError, match="webp"):
        write_animation(tmp_path / "a.mp4", [picture], 10)
    assert not list(tmp_path.iterdir())
