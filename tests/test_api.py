"""The Python interface: the snippets of docs/python.md run in order, and what it refuses."""

import re
from pathlib import Path

import numpy as np
import pytest

from avatar import api
from avatar.checks import AvatarError
from avatar.io.meshes import read_mesh
from avatar.io.motions import write_motion
from avatar.io.points import read_points
from avatar.records import PointCloud, Surface
from avatar.simulate.angles import authored_motion

PAGE = Path(__file__).parents[1] / "docs" / "python.md"
QUICK = '"train.steps=2", "train.batch=1", "train.points=300", "train.scan_points=300", "scan.points=1000"'


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> dict:
    """The names that the page's snippets define, run in a folder with the motion that they name."""
    folder, names = tmp_path_factory.mktemp("page"), {}
    write_motion(folder / "walk.npz", authored_motion("walk", fps=30, seconds=0.2))
    snippets = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(snippets) >= 6
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for snippet in snippets:
            code = snippet.replace('"train.minutes=2"', QUICK)
            exec(compile(code, str(PAGE), "exec"), names)
    return names | {"folder": folder}


@pytest.mark.slow
def test_the_page_does_what_it_says(page):
    folder = page["folder"]
    assert page["run"] == Path("runs/closet/sample/dress/default") and page["avatar"].outfits == ("dress",)
    assert page["points"].shape == page["normals"].shape == (20_000, 3)
    assert len(page["frames"]) == 3 and np.ptp(page["frames"][0].cloud.points[:, 1]) > 1.2
    assert len(read_mesh(folder / "dressed.obj").faces) == len(page["mesh"].faces) > 1000
    assert len(read_points(folder / "dressed.ply").points) == 5_000


@pytest.mark.slow
def test_a_pose_and_a_motion_of_it_give_the_same_surface(page):
    avatar = page["avatar"]
    motion = page["motion"]
    one = avatar.pose(motion.poses[0], points=2_000)
    assert np.array_equal(one.cloud.points, next(avatar.animate(motion, points=2_000)).cloud.points)
    with pytest.raises(AvatarError, match="trained on dress, not on 'skirt'"):
        avatar.pose(motion.poses[0], outfit="skirt")
    with pytest.raises(AvatarError, match=r"poses: expected .* got \(1, 5, 3\)"):
        avatar.pose(np.zeros((5, 3)))
    with pytest.raises(AvatarError, match="translations"):
        next(avatar.animate(api.Motion(motion.poses, motion.translations[:1], 30.0, "short")))


def test_settings_are_read_as_on_the_command_line(tmp_path):
    folder = tmp_path / "my runs, 2"
    assert api.run_settings("size=small", f"runs_root={folder}").runs_root == folder
    with pytest.raises(AvatarError, match=r"train\.stepz.*steps"):
        api.run_settings("train.stepz=3")


def test_scores_of_two_surfaces():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2_000, 3)).astype(np.float32)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cloud, larger = PointCloud(points, points), PointCloud(1.1 * points, points)
    found = api.score(Surface(cloud), larger, ["cd_point", "normal_l1_mean"])
    assert found["cd_point"] == pytest.approx(2 * 0.1**2, rel=0.05) and found["normal_l1_mean"] < 0.05
    assert api.score(cloud, cloud) == {"cd_point": 0.0, "normal_l1_mean": 0.0, "f_score_5mm": 1.0}
    for name in ("penetration_share", "jitter", "self_intersection"):
        with pytest.raises(AvatarError, match=name):
            api.score(cloud, cloud, [name])


def test_a_surface_with_a_mesh_is_not_meshed_again():
    mesh = api.Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))
    assert api.to_mesh(Surface(PointCloud(mesh.vertices, mesh.vertices), mesh)) is mesh
