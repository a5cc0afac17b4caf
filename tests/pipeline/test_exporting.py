"""Exported sequences read back: every frame at the time of its number, at the speed it was predicted at."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from pygltflib import GLTF2

from avatar.io.meshes import write_mesh
from avatar.io.motions import read_motion, write_motion
from avatar.io.points import read_points, write_points
from avatar.pipeline.scores import PredictConfig, meshes_folder, predict, predicted_fps
from avatar.pipeline.surfaces import ExportConfig, export, numbered_frames
from avatar.records import Mesh, PointCloud
from avatar.simulate.angles import authored_motion

Usd = pytest.importorskip("pxr.Usd")


def times(path: Path, prim: str) -> tuple[float, float, float, list[float]]:
    """Time codes a second, first, last, and those of all samples of a USD file."""
    stage = Usd.Stage.Open(str(path))
    samples = stage.GetPrimAtPath(f"/avatar/{prim}").GetAttribute("points").GetTimeSamples()
    return stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode(), samples


@pytest.mark.slow
def test_a_motion_with_some_meshes_plays_at_the_speed_it_was_predicted_at(run, tmp_path):
    """Of 9 frames at 20 a second three are meshed; then the same motion at 10: nothing of the others is left."""
    motion = tmp_path / "stroll.npz"
    write_motion(motion, replace(authored_motion("walk", fps=20, seconds=0.4), name="stroll"))
    last = len(read_motion(motion, 20).poses) - 1
    (folder,) = predict(PredictConfig(run=run, motion=motion, fps=20, points=1000, device="cpu"))
    ball = trimesh.creation.icosphere(1)
    for number in (0, last // 2, last):
        place = meshes_folder(run, "stroll", folder.name) / f"stroll.{number:05d}.ply"
        write_mesh(place, Mesh(np.array(ball.vertices), np.array(ball.faces)))
    made = {path.name: path for path in export(ExportConfig(run=run, predictions="stroll", motion=motion))}
    assert times(made["points.usdc"], "points") == (20, 0, last, list(range(last + 1)))
    held = [0, last // 2 - 1, last // 2, last - 1, last]
    assert times(made["meshes.usdc"], "mesh") == (20, 0, last, held)
    (animation,) = (document := GLTF2().load(str(made["body.glb"]))).animations
    assert document.accessors[animation.samplers[0].input].max == pytest.approx([last / 20])
    film, length = Image.open(made["preview.webp"]), 0
    for frame in range(film.n_frames):
        film.seek(frame)
        film.load()
        length += film.info["duration"]
    assert length == 1000 * (last + 1) / 20
    (folder,) = predict(PredictConfig(run=run, motion=motion, fps=10, points=1000, device="cpu"))
    assert predicted_fps(folder) == 10 and len(list(folder.glob("*.ply"))) == last // 2 + 1


@pytest.mark.slow
def test_frames_of_a_split_are_exported_by_sequence_at_the_times_of_their_numbers(run):
    """Names as data sets have them: several sequences, numbers from N on, a gap, and no zeros before them."""
    (source,) = predict(PredictConfig(run=run, points=1000, device="cpu"))
    cloud = read_points(min(source.glob("*.ply")))
    folder = run / "predictions" / "chosen" / source.name
    for place, name in enumerate(("walk.9", "walk.10", "walk.20", "squat.00072")):
        write_points(folder / f"{name}.ply", PointCloud(cloud.points + np.float32([place, 0, 0]), cloud.normals))
    made = export(ExportConfig(run=run, predictions="chosen", fps=24))
    target = run / "export" / "chosen" / source.name
    names = {
        f"{sequence}/{file}" for sequence in ("walk", "squat") for file in ("points.usdc", "preview.webp", "frames.png")
    }
    assert {str(path.relative_to(target)) for path in made} == names | {"body.glb"}
    assert times(target / "walk" / "points.usdc", "points") == (24, 9, 20, [9, 10, 19, 20])
    stage = Usd.Stage.Open(str(target / "walk" / "points.usdc"))
    points = stage.GetPrimAtPath("/avatar/points").GetAttribute("points")
    assert [round(points.Get(t)[0][0] - float(cloud.points[0, 0])) for t in (9, 10, 19, 20)] == [0, 1, 1, 2]
    assert times(target / "squat" / "points.usdc", "points") == (24, 72, 72, [72])


def test_frames_are_told_by_sequence_and_number():
    found = numbered_frames(["b.2", "a.10", "a.9", "b.00001"])
    assert found == {"a": {9: "a.9", 10: "a.10"}, "b": {1: "b.00001", 2: "b.2"}}
    assert numbered_frames(["left", "a.b"]) == {"frames": {0: "a.b", 1: "left"}}
    with pytest.raises(ValueError, match=r"one frame a number, got a\.01 and a\.1"):
        numbered_frames(["a.1", "a.01"])
