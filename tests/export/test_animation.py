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


def samples_of(attribute):
    """The first coordinate at each time sample."""
    return {time: attribute.Get(time)[0][0] for time in attribute.GetTimeSamples()}


@pytest.mark.parametrize("kind", ["points", "meshes"])
def test_frames_stand_at_their_numbers_and_are_held_where_numbers_are_missing(tmp_path, kind):
    """Frames 7, 8 and 12 of a sequence at 24 a second: nothing is blended over the gap."""
    path, numbers = tmp_path / "a.usda", [7, 8, 12]
    moved = [np.full((12, 3), shift, np.float32) + sphere(0).vertices for shift in (0, 1, 2)]
    if kind == "points":
        write_usd_points(path, (PointCloud(points, sphere(0).vertices) for points in moved), 24, numbers)
    else:
        write_usd_meshes(path, (Mesh(points, sphere(0).faces) for points in moved), 24, numbers)
    stage = Usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (7, 12)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 24
    prim = UsdGeom.PointBased(stage.GetPrimAtPath(f"/avatar/{'points' if kind == 'points' else 'mesh'}"))
    start = moved[0][0, 0]
    expected = {7: 0, 8: 1, 11: 1, 12: 2}
    assert samples_of(prim.GetPointsAttr()) == pytest.approx({t: start + shift for t, shift in expected.items()})
    assert prim.GetPointsAttr().Get(9.5)[0][0] == pytest.approx(start + 1)  # as a program that blends shows it


@pytest.mark.parametrize(
    ("suffix", "fps", "durations"), [(".webp", 30, [33, 334, 300, 33]), (".gif", 30, [30, 340, 300, 30])]
)
def test_a_film_shows_each_picture_until_the_next_ones_time(tmp_path, suffix, fps, durations):
    """Frames 4, 5, 15 and 24; 667 ms to the beginning of the last, whatever the ticks are rounded to."""
    from PIL import Image

    colors = [[250, 0, 0], [0, 250, 0], [0, 0, 250], [250, 250, 0]]
    images = [np.full((32, 48, 3), color, np.uint8) for color in colors]
    write_animation(tmp_path / f"a{suffix}", images, fps, [4, 5, 15, 24])
    film, found = Image.open(tmp_path / f"a{suffix}"), []
    for frame in range(film.n_frames):
        film.seek(frame)
        film.load()
        found.append(film.info["duration"])
    assert found == durations


def test_films_do_not_run_fast_by_what_ticks_are_rounded(tmp_path):
    from PIL import Image

    pictures = [np.full((8, 8, 3), shade, np.uint8) for shade in range(0, 240, 4)]
    write_animation(tmp_path / "a.gif", pictures, 60)  # 16.7 ms in steps of 10
    film, length = Image.open(tmp_path / "a.gif"), 0
    for frame in range(film.n_frames):
        film.seek(frame)
        length += film.info["duration"]
    assert (film.n_frames, length) == (60, 1000)


@pytest.mark.parametrize("frames", [[0, 1], [0, 1, 2, 3], [0, 2, 2], [0, 3, 1]])
def test_numbers_that_do_not_fit_are_refused(tmp_path, frames):
    picture = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(AvatarError, match="frames: expected"):
        write_usd_points(tmp_path / "a.usdc", [cloud(9)] * 3, 24, frames)
    with pytest.raises(AvatarError, match="frames: expected"):
        write_animation(tmp_path / "a.gif", [picture] * 3, 24, frames)
    assert not list(tmp_path.iterdir())


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
