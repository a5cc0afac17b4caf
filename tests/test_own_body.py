"""A person of one's own, by the commands alone: SMPL's file converted, frames packed, trained, moved and exported."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from glb import Glb
from motion_files import write_amass, write_bvh
from scipy.spatial import cKDTree
from smpl_person import BETAS, PARENTS, pose_person, rest_joints, whole_pose, write_model, write_person

from avatar.data.layouts import find_outfit
from avatar.io.meshes import read_mesh
from avatar.io.points import read_points
from avatar.records import Motion
from avatar.simulate.angles import authored_motion

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
RUN = "runs/closet/mine/coat/default"
QUICK = "train.steps=4 train.points=500 train.scan_points=500 train.mirror=false"
NEAR = 0.06  # metres between cloud and body; the body's vertices and the cloud's points lie 3 cm apart
MESHED = 0.1  # metres; Poisson's surface bridges gaps between limbs


def run(folder: Path, *lines: str) -> None:
    """Commands as one types them, from a folder of one's own; several go at once."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    options = {"cwd": folder, "env": environment, "text": True, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    running = []
    for line in lines:
        tool, *words = line.split()
        running.append(subprocess.Popen([sys.executable, str(ROOT / "tools" / tool), *words], **options))
    for line, process in zip(lines, running):
        said = process.communicate(timeout=600)[0]
        assert process.returncode == 0, f"{line}\n{said}"


@pytest.fixture(scope="module")
def walk() -> Motion:
    """Three frames of a walk that goes forwards and turns."""
    motion = authored_motion("walk", fps=30, seconds=0.1)
    poses = motion.poses[:3].copy()
    poses[:, 0, 1] += 0.8
    return Motion(poses, np.float32([[0, 0, 0], [0.1, 0.02, 0.3], [0.2, 0, 0.6]]), 30.0, "walk")


@pytest.fixture(scope="module")
def home(person, walk, tmp_path_factory) -> Path:
    """A folder in which all of it has been done: ``data``, ``runs``, motions."""
    folder = tmp_path_factory.mktemp("own")
    write_model(folder / "SMPL_MINE.pkl", person)
    yaml = f"body:\n  path: ../../bodies/mine.npz\n  betas: {list(BETAS)}\n"
    write_person(folder / "data" / "mine" / "coat", person, yaml)
    write_amass(folder / "amass.npz", walk)
    write_bvh(folder / "bvh.bvh", walk, rest=rest_joints(person))
    run(folder, "convert_body.py SMPL_MINE.pkl data/bodies/mine.npz")
    run(folder, f"train.py dataset=mine outfit=coat {QUICK}")
    predict = f"predict.py run={RUN} points=3000"
    run(folder, predict, f"{predict} motion=amass.npz", f"{predict} motion=bvh.bvh")
    run(folder, f"mesh.py run={RUN} predictions=amass formats=[ply] poisson.depth=7 poisson.max_hole=0.1")
    run(folder, f"export.py run={RUN} predictions=amass motion=amass.npz")
    return folder


def assert_dressed(points: np.ndarray, body: np.ndarray, near: float = NEAR) -> None:
    """Points all over a body, and nowhere else: in metres, upright, where it stands."""
    assert cKDTree(body).query(points)[0].max() < near
    assert cKDTree(points).query(body)[0].max() < 2 * NEAR


def walking(person: dict[str, np.ndarray], walk: Motion) -> list[np.ndarray]:
    """The person in the walk's frames."""
    return [pose_person(person, whole_pose(p), t).vertices for p, t in zip(walk.poses, walk.translations)]


def test_the_pose_of_a_frame_gives_its_vertices(home):
    outfit = find_outfit(home / "data", "mine", "coat")
    assert len(outfit.template.parents) == len(PARENTS) == 24
    for split in ("train", "test"):
        for name in outfit.frames(split):
            body = outfit.load(split, name).body
            posed = outfit.fit_pose(body.pose, body.translation)
            np.testing.assert_allclose(posed.vertices, body.vertices, atol=1e-5)
            np.testing.assert_allclose(posed.pose_vertices, body.pose_vertices, atol=1e-5)


def test_test_frames_are_predicted_over_their_bodies(home):
    outfit = find_outfit(home / "data", "mine", "coat")
    for name in outfit.frames("test"):
        cloud = read_points(home / RUN / "predictions" / "test" / "coat" / f"{name}.ply")
        assert_dressed(cloud.points, outfit.load("test", name).body.vertices)


@pytest.mark.parametrize("motion", ["amass", "bvh"])
def test_motions_move_the_person(home, person, walk, motion):
    paths = sorted((home / RUN / "predictions" / motion / "coat").glob("*.ply"))
    assert len(paths) == 3
    for path, body in zip(paths, walking(person, walk)):
        assert_dressed(read_points(path).points, body)


def test_meshes_and_caches_are_in_metres_and_upright(home, person, walk):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    folder = home / RUN / "export" / "amass" / "coat"
    assert (folder / "preview.webp").stat().st_size > 1000
    bodies = walking(person, walk)
    meshes = sorted((home / RUN / "meshes" / "amass" / "coat").glob("*.ply"))
    for path, body in zip(meshes, bodies, strict=True):
        assert_dressed(read_mesh(path).vertices, body, MESHED)
    for file, prim in (("points.usdc", UsdGeom.Points), ("meshes.usdc", UsdGeom.Mesh)):
        stage = Usd.Stage.Open(str(folder / file))
        assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
        found = next(prim(node) for node in stage.Traverse() if node.IsA(prim))
        for frame, body in enumerate(bodies):
            assert_dressed(np.array(found.GetPointsAttr().Get(frame)), body, MESHED)


def test_the_rigged_body_walks_as_the_person_does(home, person, walk):
    """Its vertices are SMPL's without the pose blendshapes, which glTF has no place for."""
    glb = Glb(home / RUN / "export" / "amass" / "coat" / "body.glb")
    still = person | {"posedirs": 0 * person["posedirs"]}
    for frame, body in enumerate(walking(still, walk)):
        np.testing.assert_allclose(glb.skinned(frame), body, atol=2e-3)  # eight weights a vertex
