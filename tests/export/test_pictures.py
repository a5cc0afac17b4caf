"""Pictures: what is drawn where, in which colour, from which side."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from avatar.checks import AvatarError, DataError
from avatar.export import pictures
from avatar.export.pictures import (
    BACKGROUND,
    Camera,
    color_bar,
    contact_sheet,
    cropped,
    frame_camera,
    map_colors,
    render_error,
    render_mesh,
    render_points,
    save_picture,
)
from avatar.records import Mesh, PointCloud

PAPER = np.rint(np.array(BACKGROUND) * 255)
SIZE = (160, 240)


def box_cloud(width=0.4, height=1.6, depth=0.2, spacing=0.02):
    """Points on a box standing on the ground, normals outwards; a person's proportions."""
    solid = trimesh.creation.box((width, height, depth))
    points, faces = trimesh.sample.sample_surface(solid, int(solid.area / spacing**2), seed=0)
    return PointCloud(points + [0, height / 2, 0], solid.face_normals[faces])


def project(camera, points):
    """Pixel coordinates ``(N, 2)``, column and row from the upper left corner, of ``(N, 3)`` points."""
    across, up, _ = camera.axes @ (np.asarray(points, np.float64) - camera.center).T
    scale = camera.size[1] / camera.extent
    return np.stack([camera.size[0] / 2 + across * scale, camera.size[1] / 2 - up * scale], axis=1)


def drawn(picture):
    """Where something was drawn: rows and columns of the pixels that are not paper."""
    return np.argwhere((np.abs(picture - PAPER) > 8).any(axis=-1))


def test_a_picture_shows_the_cloud_where_the_camera_projects_it():
    cloud = box_cloud()
    for view in ("front", "side", "back", "three_quarter"):
        camera = frame_camera(cloud.points, view, SIZE)
        pixels = drawn(render_points(cloud, camera))
        expected = project(camera, cloud.points)[:, ::-1]
        assert expected.min() >= 0 and (expected.max(axis=0) < SIZE[::-1]).all()
        reach = 0.05 * SIZE[1] / camera.extent + 1  # a disc and a pixel
        np.testing.assert_allclose(pixels.min(axis=0), expected.min(axis=0), atol=reach)
        np.testing.assert_allclose(pixels.max(axis=0), expected.max(axis=0), atol=reach)


def test_projection_of_known_points():
    camera = Camera((0.0, 1.0, 0.0), 2.0, size=(100, 200))
    points = np.array([[0, 1, 0], [0.5, 1, 0], [0, 2, 0], [0, 1, 9.0]])
    np.testing.assert_allclose(project(camera, points), [[50, 100], [100, 100], [50, 0], [50, 100]])
    from_left = camera.seen_from("left")  # the person's left is +x: +z then points to the picture's left
    np.testing.assert_allclose(project(from_left, [[0, 1, 0.5]]), [[0, 100]])
    from_below = replace(camera, elevation=-30.0)  # +z then points down
    np.testing.assert_allclose(project(from_below, [[0, 1, 1], [0.5, 1, 0]]), [[50, 50], [100, 100]], atol=1e-9)
    for view in (camera, from_left, replace(from_left, elevation=-30.0)):
        np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)


def test_red_is_red_and_a_surface_has_no_holes():
    cloud = box_cloud()
    camera = frame_camera(cloud.points, size=SIZE)
    picture = render_points(cloud, camera, colors=(0.9, 0.0, 0.0)).astype(int)
    pixels = drawn(picture)
    top, left = pixels.min(axis=0) + 6
    bottom, right = pixels.max(axis=0) - 6
    inside = picture[top:bottom, left:right]
    assert (inside[..., 0] > 150).mean() > 0.995
    assert inside[..., 1:].max() < 60


def test_normal_colors_and_back_sides():
    cloud = box_cloud()
    camera = frame_camera(cloud.points, size=SIZE)
    center = (slice(100, 140), slice(70, 90))
    front = render_points(cloud, camera)[center].reshape(-1, 3)
    np.testing.assert_allclose(np.median(front, axis=0), [128, 128, 255], atol=4)  # facing the camera
    back = render_points(cloud, camera.seen_from("back"))[center].reshape(-1, 3)
    np.testing.assert_allclose(np.median(back, axis=0), [128, 128, 255], atol=4)
    inside_out = render_points(PointCloud(cloud.points, -cloud.normals), camera)[center].reshape(-1, 3)
    np.testing.assert_allclose(np.median(inside_out, axis=0), np.array([128, 128, 255]) * 0.42, atol=4)


def test_front_and_back_differ():
    cloud = box_cloud()
    painted = np.where(cloud.points[:, 2:] > 0, [[0.9, 0.1, 0.1]], [[0.1, 0.1, 0.9]])
    camera = frame_camera(cloud.points, size=SIZE)
    front = render_points(cloud, camera, painted)[120, 80].astype(int)
    back = render_points(cloud, camera.seen_from("back"), painted)[120, 80].astype(int)
    assert front[0] > 150 > back[0] and back[2] > 150 > front[2]


def test_a_mesh_is_lit_colored_and_dark_inside():
    solid = trimesh.creation.cylinder(0.2, 1.0, transform=trimesh.geometry.align_vectors([0, 0, 1], [0, 1, 0]))
    sides = np.abs(solid.face_normals[:, 1]) < 0.5
    colors = np.tile([0.2, 0.8, 0.2], (len(solid.vertices), 1))
    kept = sides & ~(solid.triangles_center[:, [0, 2]] > 0).all(axis=1)  # without the right half of the front
    tube = Mesh(np.array(solid.vertices), np.array(solid.faces[kept]), colors)
    camera = frame_camera(tube.vertices, size=SIZE)
    picture = render_mesh(tube, camera).astype(int)
    outside = project(camera, [[-0.1, -0.2, 0.17]])[0].round().astype(int)
    inside = project(camera, [[0.1, -0.2, -0.17]])[0].round().astype(int)
    light, dark = picture[outside[1], outside[0]], picture[inside[1], inside[0]]
    assert light[1] > 2 * light[0] and dark[1] > 2 * dark[0]
    assert dark[1] < 0.6 * light[1]
    clay = render_mesh(Mesh(tube.vertices, tube.faces), camera)[outside[1], outside[0]].astype(int)
    assert clay[0] > clay[1] > clay[2]


def test_error_colors_are_the_map_s_ends():
    cloud = box_cloud()
    camera = frame_camera(cloud.points, size=SIZE)
    low, high = map_colors(np.array([0.0, 1.0]))
    for error, color in ((0.0, low), (0.02, high), (5.0, high)):
        picture = render_error(cloud, np.full(len(cloud.points), error), 0.02, camera)
        shown = picture[100:140, 70:90].reshape(-1, 3).mean(axis=0) / 255
        np.testing.assert_allclose(shown / shown.sum(), color / color.sum(), atol=0.05)


def test_the_same_cloud_gives_the_same_picture():
    cloud = box_cloud()
    np.testing.assert_array_equal(render_points(cloud), render_points(cloud))


def test_sheets_place_pictures_and_labels(tmp_path):
    red, blue = (np.full((64, 32, 3), color, np.uint8) for color in ([200, 0, 0], [0, 0, 200]))
    plain = contact_sheet([[red, blue], [blue]], gap=4)
    assert plain.shape == (132, 68, 3)
    np.testing.assert_array_equal(plain[:64, 36:], blue)
    np.testing.assert_array_equal(plain[68:, :32], blue)
    np.testing.assert_array_equal(plain[70, 50], PAPER)
    labelled = contact_sheet([[red, blue]], ["one"], ["left", "a very long label indeed"])
    assert (labelled[-64:, :24] != PAPER).any() and (labelled[:24, 24:56] != PAPER).any()
    np.testing.assert_array_equal(labelled[24:, 24:56], red)
    for path in (tmp_path / "a.png", tmp_path / "a.jpg"):
        save_picture(path, labelled)
        assert path.stat().st_size > 200
    from PIL import Image

    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), labelled)


def test_the_scale_runs_from_low_to_high():
    bar = color_bar(0.02, height=200).astype(float)
    low, high = map_colors(np.array([0.0, 1.0])) * 255
    np.testing.assert_allclose(bar[24, 18], high, atol=12)
    np.testing.assert_allclose(bar[-14, 18], low, atol=12)


def test_wrong_arguments_are_named():
    cloud = box_cloud()
    picture = np.zeros((8, 8, 3), np.uint8)
    for name, action in {
        "view": lambda: frame_camera(cloud.points, "below"),
        "points": lambda: frame_camera(cloud.points[:0]),
        "colors": lambda: render_points(cloud, colors="pretty"),
        "colors: expected": lambda: render_points(cloud, colors=(255, 0, 0)),
        "errors": lambda: render_error(cloud, np.zeros(3), 0.02),
        "max_error": lambda: render_error(cloud, np.zeros(len(cloud.points)), 0.0),
        "rows": lambda: contact_sheet([]),
        "one size": lambda: contact_sheet([[picture, picture[:4]]]),
        "row_labels": lambda: contact_sheet([[picture]], ["a", "b"]),
        "normals": lambda: render_points(PointCloud(cloud.points, cloud.normals[:-1])),
        "indices": lambda: render_mesh(Mesh(cloud.points, np.array([[0, 1, 10**6]]))),
    }.items():
        with pytest.raises(AvatarError, match=name):
            action()
    with pytest.raises(DataError, match=r"\.png"):
        save_picture("a.bmp", picture)


def test_a_machine_without_gl_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(pictures, "GL_LIBRARIES", ("libnothing.so.1",))
    with pytest.raises(AvatarError, match="apt-get install"):
        render_points(box_cloud())


def test_what_torch_loads_late_may_come_after_a_picture():
    """Mesa's and triton's LLVM: the other way round the process ends by a signal."""
    code = (
        "import numpy as np; from avatar.export.pictures import render_points; from avatar.records import PointCloud\n"
        "points = np.random.default_rng(0).normal(size=(50, 3)); normals = np.tile([0.0, 0.0, 1.0], (50, 1))\n"
        "render_points(PointCloud(points, normals))\n"
        "import roma; print('drawn')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, "drawn\n"), done.stderr


def test_pictures_are_cropped_to_what_any_of_them_shows():
    pictures = [np.full((40, 60, 3), PAPER, np.uint8) for _ in range(2)]
    pictures[0][10:12, 20:22] = 0
    pictures[1][30, 40] = 0
    found = cropped(pictures, margin=3)
    assert [picture.shape for picture in found] == [(27, 27, 3)] * 2 and (found[0][3, 3] == 0).all()
    blank = [np.full((4, 5, 3), PAPER, np.uint8)]
    assert cropped(blank)[0].shape == (4, 5, 3)
