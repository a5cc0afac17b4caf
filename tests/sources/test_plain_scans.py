"""Plain folders of scans: which files are read as what, and outfits converted from them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import mixamo_rig, write_rig
from smpl_person import BETAS, pose_person, rest_joints, write_model

from avatar.body.model import SMPL_JOINTS
from avatar.body.packed import write_body
from avatar.body.smpl import convert_body_model
from avatar.checks import AvatarError, DataError
from avatar.data.packed_layout import PackedOutfit
from avatar.io.ledger import file_digest
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.records import Mesh, PointCloud
from avatar.sources.base import SourceBody
from avatar.sources.conversion import ConvertConfig, convert_outfit
from avatar.sources.placement import TURNS
from avatar.sources.plain import PlainScans
from avatar.sources.registry import open_sources


@pytest.fixture(scope="module")
def body(tiny_outfit):
    return tiny_outfit.body


@pytest.fixture(scope="module")
def frames(tiny_outfit):
    """Four dressed frames of the tiny outfit."""
    return [tiny_outfit.load("train", name) for name in tiny_outfit.frames("train")[:4]]


@pytest.fixture(scope="module")
def template(body, tmp_path_factory):
    """The body's file."""
    path = tmp_path_factory.mktemp("body") / "template.npz"
    write_body(path, body)
    return path


@pytest.fixture(scope="module")
def parameters(frames):
    poses = np.stack([frame.body.pose for frame in frames]).reshape(len(frames), -1)
    return {"poses": poses, "trans": np.stack([frame.body.translation for frame in frames])}


def write_scans(folder: Path, frames, stems=None, normals=True, up="y", scale=1.0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(frames):
        stem = stems[number] if stems else f"scan_{number + 8}"  # 8, 9, 10, 11: not the order of letters
        points = (scale * frame.scan.points @ TURNS[up]).astype(np.float32)
        turned = (frame.scan.normals @ TURNS[up]).astype(np.float32)
        if normals:
            write_points(folder / f"{stem}.ply", PointCloud(points, turned))
        else:
            text = "\n".join(" ".join(f"{x:.6f}" for x in point) for point in points)
            head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
            (folder / f"{stem}.ply").write_text(f"{head}property float z\nend_header\n{text}\n")
    return folder


def config(folder: Path, **options) -> ConvertConfig:
    return ConvertConfig(source=folder, data_root=folder.parent / "data", **options)


def opened(folder: Path, **options) -> PlainScans:
    (source,) = open_sources(config(folder, **options))
    assert isinstance(source, PlainScans)
    return source


def converted(folder: Path, **options) -> PackedOutfit:
    return PackedOutfit(convert_outfit(opened(folder, **options), config(folder, **options)))


def loaded(outfit: PackedOutfit) -> list:
    splits = [split for split in ("train", "test") if outfit.has_frames(split)]
    return [outfit.load(split, name) for split in splits for name in outfit.frames(split)]


def assert_frames(found, frames, atol=1e-6):
    for one, other in zip(found, frames, strict=True):
        np.testing.assert_allclose(one.scan.points, other.scan.points, atol=atol)
        np.testing.assert_allclose(one.scan.normals, other.scan.normals, atol=1e-5)
        np.testing.assert_allclose(one.body.vertices, other.body.vertices, atol=atol)
        np.testing.assert_allclose(one.body.vertex_transforms, other.body.vertex_transforms, atol=1e-4)


@pytest.fixture(scope="module")
def outfit(frames, parameters, template, tmp_path_factory):
    """A folder with one file of parameters and the body, in cm and z up, converted; with what systems leave."""
    folder = write_scans(tmp_path_factory.mktemp("plain") / "Coat of mine", frames, up="z", scale=100)
    np.savez(folder / "smpl.npz", **parameters)
    shutil.copy(template, folder / "template.npz")
    for name in ("._scan_8.ply", ".hidden.ply", "Thumbs.db", "scan_8.png", "scan_8.mtl", "notes.xyz"):
        (folder / name).write_bytes(b"nothing")
    before = {path: file_digest(path) for path in folder.iterdir()}
    result = converted(folder)
    assert before == {path: file_digest(path) for path in folder.iterdir()}
    return folder, result


def test_a_folder_becomes_an_outfit(outfit, frames):
    folder, result = outfit
    assert result.path == folder.parent / "data" / "mine" / "Coat_of_mine"
    assert result.frames("train") == ("scan.08", "scan.09", "scan.10") and result.frames("test") == ("scan.11",)
    assert_frames(loaded(result), frames)
    record = json.loads((result.path / "source.json").read_text())
    assert record["decisions"] == {"units": "cm", "up": "z", "fit units": "m", "fit up": "y"}
    assert [Path(path).name for path in record["frames"]["train/scan.08"]] == ["scan_8.ply", "smpl.npz"]


def test_what_is_finished_is_not_made_again(outfit, parameters, frames):
    folder, result = outfit
    kept = result.path / "train" / "scan.08.npz"
    stamp = kept.stat().st_mtime_ns
    (result.path / "train" / "scan.09.npz").unlink()
    assert_frames(loaded(converted(folder)), frames)
    assert kept.stat().st_mtime_ns == stamp
    np.savez(folder / "smpl.npz", poses=parameters["poses"], trans=parameters["trans"] + np.float32([0, 0.01, 0]))
    moved = loaded(converted(folder))
    np.savez(folder / "smpl.npz", **parameters)
    np.testing.assert_allclose(moved[0].body.vertices[:, 1], frames[0].body.vertices[:, 1] + 0.01, atol=1e-6)


def test_other_files_are_named(outfit, caplog):
    assert len(opened(outfit[0]).frames) == 4
    assert "1 files that nothing is known of, or damaged, are left out: notes.xyz." in caplog.text


def test_parameters_of_each_scan_as_json(frames, template, tmp_path):
    folder = write_scans(tmp_path / "scans", frames[:2])
    shutil.copy(template, folder / "body.npz")
    for number, frame in enumerate(frames[:2]):
        pose = frame.body.pose.astype(float)
        record = {"global_orient": pose[:1].tolist(), "body_pose": [pose[1:].ravel().tolist()]}
        record |= {"transl": frame.body.translation.astype(float).tolist(), "expression": [0.0] * 10}
        (folder / f"scan_{number + 8}_smplx.json").write_text(json.dumps([record] if number else record))
    assert_frames(loaded(converted(folder)), frames[:2])


@pytest.mark.parametrize("place", ["beside", "folder", "given"])
def test_meshes_of_the_body(frames, body, tmp_path, place, template):
    """Their poses are solved for; the meshes are in millimetres, the scans in metres."""
    folder, options = write_scans(tmp_path / "scans", frames[:2]), {}
    shutil.copy(template, tmp_path / "theirs.npz")
    for number, frame in enumerate(frames[:2]):
        mesh = Mesh(1000 * frame.body.vertices, body.faces.numpy())
        target = {
            "beside": folder / f"scan_{number + 8}_smpl.ply",
            "folder": folder / "SMPL" / f"scan_{number + 8}.ply",
        }
        target = target.get(place, tmp_path / "fits" / f"scan_{number + 8}_fit.ply")
        target.parent.mkdir(exist_ok=True)
        write_mesh(target, mesh)
    if place == "given":
        options["fits"] = tmp_path / "fits"
    source = opened(folder, body=SourceBody(tmp_path / "theirs.npz"), **options)
    posed = [source.read(frame) for frame in source.frames]
    for one, frame in zip(posed, frames, strict=False):
        np.testing.assert_allclose(one.vertices, frame.body.vertices, atol=1e-6)
        np.testing.assert_allclose(one.pose, frame.body.pose, atol=1e-3)
        np.testing.assert_allclose(one.translation, frame.body.translation, atol=1e-4)
    mesh = source.body_mesh(source.frames[0])
    np.testing.assert_allclose(mesh.vertices, frames[0].body.vertices, atol=1e-6)


def test_posed_vertices_and_a_rigged_body_beside_them(frames, body, tmp_path):
    folder = write_scans(tmp_path / "scans", frames[:3])
    np.savez(folder / "fits.npz", vertices=np.stack([frame.body.vertices for frame in frames[:3]]))
    write_rig(folder / "body.glb", mixamo_rig(body))
    result = converted(folder)
    assert_frames(loaded(result), frames[:3])
    assert list(result.body.joint_names) == SMPL_JOINTS
    np.testing.assert_allclose(loaded(result)[0].body.pose, frames[0].body.pose, atol=1e-3)


def test_a_shape_beside_the_parameters(person, tmp_path, caplog):
    """SMPL's model in the shape of the parameters' betas, turned z up about the pelvis of that shape."""
    convert_body_model(write_model(tmp_path / "SMPL.pkl", person), tmp_path / "smpl.npz")
    pose = 0.1 * np.random.default_rng(0).standard_normal((24, 3))
    posed = pose_person(person, pose, np.array([0.1, 0.2, 0.3]))
    folder = tmp_path / "scans"
    folder.mkdir()
    write_mesh(folder / "one.obj", Mesh(posed.vertices.astype(np.float32), person["f"].astype(int)))
    np.savez(folder / "one.npz", poses=pose.reshape(1, 72), trans=[[0.1, 0.2, 0.3]], betas=[BETAS])
    source = opened(folder, body=SourceBody(tmp_path / "smpl.npz"))
    np.testing.assert_allclose(source.body.zero_joints, rest_joints(person)[:22], atol=1e-4)
    assert source.read(source.frames[0]).fitted
    np.savez(folder / "one.npz", poses=pose.reshape(1, 72), trans=[[0.1, 0.2, 0.3]], betas=[BETAS, 2 * np.array(BETAS)])
    assert opened(folder, body=SourceBody(tmp_path / "smpl.npz")).body is not None
    assert "shape coefficients differ by" in caplog.text


def test_hands_that_are_left_out_are_warned_of_once(frames, parameters, template, tmp_path, caplog):
    folder = write_scans(tmp_path / "scans", frames)
    count = len(frames)
    np.savez(folder / "p.npz", **parameters, left_hand_pose=np.full((count, 12), 0.3), jaw_pose=np.zeros((count, 3)))
    source = opened(folder, body=SourceBody(template))
    for frame in source.frames:
        assert source.read(frame).fitted
    assert caplog.text.count("hands and face of body parameters are laid at rest") == 1


def test_scans_without_bodies(frames, tmp_path):
    folder = write_scans(tmp_path / "scans", frames, up="z", scale=1000)
    source = opened(folder)
    posed = source.read(source.frames[0])
    assert not posed.fitted and source.body is None and source.decisions == {"units": "mm", "up": "z"}
    np.testing.assert_allclose(posed.scan.vertices, frames[0].scan.points, atol=1e-6)
    np.testing.assert_allclose(posed.scan.normals, frames[0].scan.normals, atol=1e-6)
    with pytest.raises(DataError, match=r"expected a body beside the scans or body\.path"):
        convert_outfit(source, config(folder))


def test_normals_are_estimated_over_the_body(frames, parameters, template, tmp_path):
    folder = write_scans(tmp_path / "scans", frames[:1], normals=False)
    np.savez(folder / "scan_8.npz", **{key: value[:1] for key, value in parameters.items()})
    shutil.copy(template, folder / "body.npz")
    (found,) = loaded(converted(folder))
    assert ((found.scan.normals * frames[0].scan.normals).sum(axis=1) > 0).mean() > 0.95


def test_sequences_and_splits(frames, parameters, template, tmp_path):
    folder = tmp_path / "scans"
    for place, sequence in enumerate(("train/walk", "test/bend")):
        write_scans(folder / sequence, frames[2 * place : 2 * place + 2], stems=["f0009", "f0010"])
        np.savez(folder / sequence / "fit.npz", **{k: v[2 * place : 2 * place + 2] for k, v in parameters.items()})
    shutil.copy(template, folder / "template.npz")
    result = converted(folder)
    assert result.frames("train") == ("walk.0009", "walk.0010") and result.frames("test") == ("bend.0009", "bend.0010")
    assert_frames(loaded(result), frames)
    write_scans(folder, frames[:1])
    with pytest.raises(DataError, match="expected scans in test, train alone"):
        opened(folder)


@pytest.mark.parametrize(
    ("stems", "names"),
    [
        (["b 2", "b 10", "b 1"], [("b.01", "b", 1), ("b.02", "b", 2), ("b.10", "b", 10)]),
        (["joan", "Bob", "ann_2"], [("ann_2", "", -1), ("Bob", "", -1), ("joan", "", -1)]),
        (["2", "10", "007"], [("scan.002", "scan", 2), ("scan.007", "scan", 7), ("scan.010", "scan", 10)]),
    ],
)
def test_names_and_order(frames, tmp_path, stems, names):
    source = PlainScans(write_scans(tmp_path / "scans", frames[:3], stems), "scans", config(tmp_path / "scans"))
    assert [(frame.name, frame.sequence, frame.number) for frame in source.frames] == names


@pytest.mark.parametrize(
    ("other", "message"),
    [("SCAN_8.PLY", "scan_8"), ("scan_8.obj", "scan_8"), ("scan 8.ply", "scan_8"), ("scan_08.ply", "scan_08")],
)
def test_duplicates_are_named(frames, tmp_path, other, message):
    folder = write_scans(tmp_path / "scans", frames[:1])
    shutil.copy(folder / "scan_8.ply", folder / other)
    if message == "scan_08":  # another number as text: two scans
        assert len(opened(folder).frames) == 2
        return
    with pytest.raises(DataError, match=r"expected (one scan of that name|scans of different names)") as error:
        opened(folder).frames  # noqa: B018
    assert other in str(error.value) and message in str(error.value)


def refused(folder: Path, match: str, **options) -> str:
    with pytest.raises(AvatarError, match=match) as error:
        source = opened(folder, **options)
        for frame in source.frames:
            source.read(frame)
    return str(error.value)


def test_fits_that_do_not_belong_are_refused(frames, parameters, template, tmp_path):
    folder = write_scans(tmp_path / "scans", frames[:2])
    shutil.copy(template, folder / "body.npz")
    np.savez(folder / "smpl.npz", **parameters)
    assert "smpl.npz" in refused(folder, "expected 2 frames, one a scan, got 4")
    np.savez(folder / "smpl.npz", vertices=np.zeros((2, 100, 3), np.float32))
    refused(folder, r"expected the 12272 vertices of the body, got 100\. Hint: give its own model as body\.path=")
    other = np.stack([frame.body.vertices for frame in frames[:2]]) * np.float32([1, 1.1, 1])
    np.savez(folder / "smpl.npz", vertices=other)
    refused(folder, "expected the body in some pose, got a mesh .* mm from the nearest")
    np.savez(folder / "more.npz", vertices=other)
    refused(folder, "expected one file of body vertices")
    refused(folder, "fits: expected a file or a folder", fits=folder / "none")
    (folder / "more.npz").unlink()
    shutil.copy(template, folder / "template.npz")
    refused(folder, "expected one body, .* is another")


def test_parameters_without_their_model(frames, parameters, tmp_path, caplog):
    folder = write_scans(tmp_path / "scans", frames)
    np.savez(folder / "smpl.npz", **parameters)
    source = opened(folder)
    assert not source.read(source.frames[0]).fitted
    assert "bodies are known, their model is not" in caplog.text


def test_units_that_fit_no_person(frames, tmp_path):
    scaled = [replace(f, scan=replace(f.scan, points=7 * f.scan.points)) for f in frames[:1]]
    assert str(tmp_path) in refused(write_scans(tmp_path / "scans", scaled), "a height of .* in no unit")


def test_a_folder_without_scans(tmp_path):
    (tmp_path / "readme.txt").write_text("nothing")
    with pytest.raises(DataError, match=r"expected files of one of the layouts .*plain"):
        open_sources(config(tmp_path))
