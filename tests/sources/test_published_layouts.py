"""Layouts of published data: found, listed, read, and converted to outfits that hold the same to a micrometre."""

import hashlib
import json
import logging
import os
import pickle
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_layouts import WRITERS, mesh_of, shaped, write_bodies, write_pickle
from scipy.spatial import cKDTree
from smpl_person import BETAS
from tiny import SETTINGS, quick_training

from avatar.api import Avatar, to_mesh
from avatar.checks import AvatarError, DataError
from avatar.data.folders import SPLITS
from avatar.data.packed_layout import PackedOutfit
from avatar.export.meshing import PoissonConfig
from avatar.io.meshes import write_mesh
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.runs.training import train
from avatar.simulate.angles import authored_motion
from avatar.sources.base import SourceBody
from avatar.sources.conversion import ConvertConfig, chosen_frames, convert_outfit, packed_arrays
from avatar.sources.registry import LAYOUTS, open_sources

MICROMETRE = 1e-6  # metres


@pytest.fixture(scope="module")
def bodies(person, tmp_path_factory):
    return write_bodies(tmp_path_factory.mktemp("bodies"), person)


@pytest.fixture(scope="module")
def originals(person, tmp_path_factory):
    """Gives a data set's folder and truth by its layout, written once; read only."""
    found = {}

    def original(layout):
        if layout not in found:
            root = tmp_path_factory.mktemp(layout) / "theirs"
            root.mkdir()
            found[layout] = root, WRITERS[layout][0](root, person)
        return found[layout]

    return original


@pytest.fixture(scope="module", params=WRITERS)
def converted(request, originals, bodies, tmp_path_factory):
    """A data set, converted: its layout and truth, the settings, and the outfits."""
    root, truth = originals(request.param)
    before = tree_digest(root)
    body = SourceBody(path=bodies[WRITERS[request.param][1]])
    config = ConvertConfig(source=root, body=body, data_root=tmp_path_factory.mktemp("data"), test=0.5)
    folders = [convert_outfit(source, config) for source in open_sources(config)]
    assert tree_digest(root) == before  # nothing of the originals is touched
    return request.param, truth, config, [PackedOutfit(folder) for folder in folders]


@pytest.fixture
def change(originals, bodies, tmp_path):
    """Gives the settings of a copy of a data set that may be changed, with its body and other settings."""

    def copied(layout, **settings):
        root = shutil.copytree(originals(layout)[0], tmp_path / "copy")
        settings = {"body": SourceBody(path=bodies[WRITERS[layout][1]])} | settings
        return ConvertConfig(source=root, layout=layout, data_root=tmp_path / "data", test=0.5, **settings)

    return copied


def tree_digest(root):
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in root.rglob("*") if path.is_file()}


def frames_of(outfits):
    """Outfit, split and name of every frame."""
    splits = [(outfit, split) for outfit in outfits for split in SPLITS if outfit.has_frames(split)]
    return [(outfit, split, name) for outfit, split in splits for name in outfit.frames(split)]


def convert(config):
    return [PackedOutfit(convert_outfit(source, config)) for source in open_sources(config)]


def read(config):
    """The arrays of every frame as conversion has them; nothing is written."""
    frames = [(source, frame) for source in open_sources(config) for frame in chosen_frames(source, config)]
    return [packed_arrays(*pair, config.points) for pair in frames]


def test_the_layout_is_found_by_its_files(converted):
    layout, _, config, outfits = converted
    sources = open_sources(config)
    assert {source.layout for source in sources} == {layout}
    assert [source.name for source in sources] == [outfit.name for outfit in outfits]
    one = open_sources(replace(config, source=sources[0].path))
    assert (one[0].layout, one[0].name, one[0].frames) == (layout, sources[0].name, sources[0].frames)


def test_scans_and_bodies_are_the_same_after_conversion(converted):
    """But for vertices of a mesh whose faces cancel out: they have no normal, and are left out."""
    _, truth, _, outfits = converted
    seen = set()
    for outfit, split, name in frames_of(outfits):
        key = next(key for key in (name, f"{split}/{name}", f"{outfit.name}/{name}") if key in truth)
        frame = outfit.load(split, name)
        gaps, rows = cKDTree(truth[key].scan).query(frame.scan.points)
        assert gaps.max() < MICROMETRE and (np.diff(rows) > 0).all() and len(rows) > 0.99 * len(truth[key].scan)
        np.testing.assert_allclose(frame.body.vertices, truth[key].body, rtol=0, atol=MICROMETRE)
        np.testing.assert_allclose(frame.body.pose[:22], truth[key].pose, rtol=0, atol=MICROMETRE)
        posed = outfit.fit_pose(frame.body.pose, frame.body.translation)
        np.testing.assert_allclose(posed.vertices, truth[key].body, rtol=0, atol=MICROMETRE)
        seen.add(key)
    assert seen == set(truth)


def test_a_second_conversion_makes_nothing_anew(converted):
    _, _, config, outfits = converted
    times = {path: path.stat().st_mtime_ns for outfit in outfits for path in outfit.path.rglob("*.npz")}
    for source in open_sources(config):
        convert_outfit(source, config)
    assert times == {path: path.stat().st_mtime_ns for path in times}


def test_every_frame_names_its_files_and_their_hashes(converted):
    _, _, config, outfits = converted
    for outfit, source in zip(outfits, open_sources(config)):
        record = json.loads((outfit.path / "source.json").read_text())
        labels = {f"{split}/{name}" for _, split, name in frames_of([outfit])}
        assert set(record["frames"]) == labels and len(labels) == len(source.frames)
        for files in record["frames"].values():
            assert {hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in files} == set(files.values())
        assert record["body"][0] == str(config.body.path)


@pytest.mark.parametrize("layout", WRITERS)
def test_missing_data_say_what_is_expected_and_where_it_is_to_be_had(layout, tmp_path):
    kind = LAYOUTS[layout]
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(DataError, match=re.escape(kind.expected)) as caught:
            open_sources(ConvertConfig(source=path, layout=layout))
        assert kind.home in str(caught.value)
    with pytest.raises(DataError, match=r"expected files of one of the layouts packed, .*found none"):
        open_sources(ConvertConfig(source=tmp_path))


@pytest.mark.parametrize("layout", [layout for layout in WRITERS if layout != "packed"])
def test_a_pose_needs_the_model_that_was_fitted(layout, change):
    kind = WRITERS[layout][1]
    config = change(layout, body=SourceBody())
    gender = "female " * (layout in ("fite", "dress4d"))  # which say so
    message = rf"expected a body beside the scans or body\.path.*its fits pose a body of kind {gender}{kind}\."
    with pytest.raises(DataError, match=rf"{message} Download the {kind} model from.*give body\.path"):
        convert(config)
    for source in open_sources(config):  # to which another body can be fitted
        posed = source.read(source.frames[0])
        assert source.body is None and not posed.fitted and 1 < posed.scan.height < 2.5


def test_frames_of_pop_need_no_model_and_keep_their_minimal_mesh(change, originals):
    (outfit,) = convert(change("packed", body=SourceBody()))
    assert outfit.body is None and len(outfit.template.joint_names) == 1
    for _, split, name in frames_of([outfit]):
        truth = originals("packed")[1][f"{split}/{name}"]
        np.testing.assert_allclose(outfit.load(split, name).body.vertices, truth.body, atol=MICROMETRE)


def test_skirt_files_give_pose_and_mean_shape(change, tmp_path):
    config = change("packed")
    (outfit,) = convert(config)
    name = outfit.frames("test")[0]
    body = outfit.load("test", name).body
    assert 0.005 < np.abs(body.pose_vertices - outfit.fit_pose(body.pose).pose_vertices).max() < 0.1
    (other,) = convert(replace(config, fits=tmp_path, name="other"))  # where there are none
    assert other.load("test", name).body.pose is None
    np.testing.assert_allclose(other.load("test", name).body.vertices, body.vertices, atol=MICROMETRE)


@pytest.mark.parametrize(
    ("layout", "pattern"),
    [("packed", "minimal_body_shape"), ("cape_raw", "minimal_body_shape"), ("fite", "data_templates")],
)
def test_a_body_needs_a_shape(layout, pattern, change):
    config = change(layout)
    shutil.rmtree(config.source / pattern)
    with pytest.raises(DataError, match=r"expected this person's shape: .*there is none\."):
        read(config)
    config.body.betas = list(BETAS)
    read(config)


def test_frames_of_pop_need_a_body_at_rest(change):
    config = change("packed", body=SourceBody())
    shutil.rmtree(config.source / "minimal_body_shape")
    with pytest.raises(
        DataError, match=r"expected a body beside the scans or body\.path, there is none\. .*in its T-pose there as"
    ):
        convert(config)


def test_a_scan_of_4d_dress_without_a_fit_is_named(change):
    config = change("dress4d")
    (config.source / "00122" / "Outer" / "Take2" / "SMPLX" / "mesh-f00011_smplx.pkl").unlink()
    with pytest.raises(DataError, match=r"mesh-f00011\.pkl: expected .* SMPLX/mesh-f00011_smplx\.pkl, there are none"):
        read(config)
    convert(replace(config, skip_invalid=True))


def test_smpl_bodies_of_4d_dress_are_read_for_such_a_model(change, bodies, originals):
    config = change("dress4d", body=SourceBody(path=bodies["smpl"]))
    for path in config.source.rglob("*_smplx.pkl"):
        stored = pickle.loads(path.read_bytes())
        pose = np.concatenate([stored["body_pose"][0], np.zeros(6)])
        kept = {key: stored[key] for key in ("global_orient", "transl", "betas")} | {"body_pose": pose}
        write_pickle(path.parents[1] / "SMPL" / path.name.replace("smplx", "smpl"), kept)
    shutil.rmtree(config.source / "00122" / "Outer" / "Take2" / "SMPLX")
    assert {arrays["pose"].shape for arrays in read(config)} == {(24, 3)}


def test_a_minimal_body_of_another_model_is_refused(change, person):
    config = change("scanimate")
    few = np.delete(shaped(person), 0, axis=0)
    faces = person["f"].astype(np.int64)
    write_mesh(config.source / "minimal.ply", replace(mesh_of(person, few), faces=faces[faces.max(1) < len(few)]))
    with pytest.raises(DataError, match=r"minimal\.ply: vertices: expected shape .*SMPL has 6890 vertices"):
        read(config)


def test_scans_without_parameters_are_named_or_left_out(change):
    config = change("scanimate")
    (config.source / "walk" / "walk.000001.npz").unlink()
    with pytest.raises(DataError, match=r"walk\.000001\.ply: expected body parameters in walk\.000001\.npz"):
        convert(config)
    (outfit,) = convert(replace(config, skip_invalid=True))
    assert [name for _, _, name in frames_of([PackedOutfit(outfit.path)])] == ["soccer.000000", "walk.000000"]


def test_poses_alone_are_no_scans(change):
    config = change("fite")
    (path,) = (config.source / "data_scans" / "ada" / "test").glob("*.npz")
    with np.load(path) as stored:
        arrays = {key: stored[key] for key in ("pose", "transl")}
    np.savez(path, **arrays)
    with pytest.raises(DataError, match=r"holds a pose without a scan\. Hint: skip_invalid=true .*motion="):
        read(config)


def test_points_of_fite_are_taken_where_there_is_no_mesh(change):
    config = change("fite")
    paths = list(config.source.glob("data_scans/ada/t*/*.npz"))
    for path in paths:
        with np.load(path) as stored:
            arrays = {key: stored[key] for key in ("pose", "transl", "scan_pc", "scan_n")}
        np.savez(path, **arrays)
    assert {arrays["scan_pc"].shape for arrays in read(config)} == {(4000, 3)}


class Payload:
    """What runs when a pickle is trusted."""

    def __init__(self, canary):
        self.canary = canary

    def __reduce__(self):
        return os.system, (f"touch {self.canary}",)


@pytest.mark.parametrize("pattern", ["Meshes_pkl/mesh-*.pkl", "SMPLX/*.pkl", "Semantic/labels/*.pkl", "basic_info.pkl"])
def test_hostile_pickles_are_refused_and_nothing_runs(pattern, change, tmp_path):
    config = change("dress4d", **({"body": SourceBody()} if pattern == "basic_info.pkl" else {}))
    for path in (config.source / "00122" / "Outer" / "Take11").glob(pattern):
        path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | {"more": Payload(tmp_path / "canary")}))
    with pytest.raises(DataError, match=r"\.pkl: .*refused posix\.system"):
        convert(config)
    assert not (tmp_path / "canary").exists()


def test_labels_and_colours_of_4d_dress_are_kept(change, originals):
    arrays = read(change("dress4d"))[0]
    rows = cKDTree(originals("dress4d")[1]["Take11.00011"].scan).query(arrays["scan_pc"])[1]
    np.testing.assert_array_equal(arrays["scan_labels"], rows % 6)
    np.testing.assert_array_equal(arrays["scan_colors"], 200)


def test_posed_bodies_of_4d_dress_are_taken_from_their_meshes(change, originals, person):
    """They have the face's expression, which no pose has; one of another frame is refused."""
    config = change("dress4d")
    truth = originals("dress4d")[1]["Take11.00011"]
    path = config.source / "00122" / "Outer" / "Take11" / "SMPLX" / "mesh-f00011_smplx.ply"
    write_mesh(path, mesh_of(person, truth.body + 0.01))
    np.testing.assert_allclose(read(config)[0]["body_verts"], truth.body + 0.01, atol=MICROMETRE)
    write_mesh(path, mesh_of(person, truth.body + 0.1))
    with pytest.raises(DataError, match=r"pose: expected it to put the template on the frame's body.*A move of"):
        convert(config)


def test_hands_as_principal_components_are_posed_where_the_model_has_them(change, caplog, tmp_path):
    config = change("dress4d")
    for path in config.source.rglob("*_smplx.pkl"):
        hands = dict.fromkeys(("left_hand_pose", "right_hand_pose"), np.zeros((1, 12), np.float32))
        write_pickle(path, pickle.loads(path.read_bytes()) | hands)
    with np.load(config.body.path) as stored:
        arrays = dict(stored)
    for found in read(config):
        np.testing.assert_allclose(found["pose"][25:].reshape(2, 45), arrays["hand_means"], rtol=1e-6)
    np.savez(tmp_path / "bare.npz", **{key: value for key, value in arrays.items() if not key.startswith("hand_")})
    config.body.path = tmp_path / "bare.npz"
    with caplog.at_level(logging.WARNING):
        assert {found["pose"].shape for found in read(config)} == {(22, 3)}
    assert "hands and face are laid at rest" in caplog.text and "convert the SMPL-X or SMPL-H file again" in caplog.text
    with pytest.raises(DataError, match=r"bare\.npz: expected principal components of hands, there are none"):
        read(replace(config, body=replace(config.body, all_joints=True)))


def test_shapes_that_differ_between_scans_are_averaged(change, caplog):
    config = change("thuman")
    path = config.source / "0000" / "smplx_param.pkl"
    stored = pickle.loads(path.read_bytes())
    write_pickle(path, stored | {"betas": stored["betas"] + 1.5})
    with caplog.at_level(logging.WARNING):
        (source,) = open_sources(config)
        np.testing.assert_allclose(source.betas[:2], np.array([0.8, -0.5]) + 0.5, atol=1e-6)
    assert "shapes differ by up to 1.0" in caplog.text


@pytest.mark.parametrize(
    ("layout", "settings", "message"),
    [
        ("cape_raw", {"units": "m"}, "That looks like millimetres"),
        ("scanimate", {"units": "cm"}, r"expected about .* m across as the body, got 2\d\."),
        ("scanimate", {"up": "z"}, "up: expected auto or y, as layout scanimate"),
        ("fite", {"outfits": ["adda"]}, "outfits: expected some of ada, got 'adda'. Did you mean 'ada'"),
        ("packed", {"split": "cape"}, "split: expected none, as layout packed has its own"),
        ("cape_raw", {"split": "scnimate"}, "split: expected one of .*Did you mean 'scanimate'"),
        ("dress4d", {"split": "4d-dress"}, "split: expected an outfit of 4d-dress .*got 00122_Outer"),
    ],
)
def test_settings_that_do_not_fit_are_refused(layout, settings, message, change):
    with pytest.raises(AvatarError, match=message):
        convert(change(layout, **settings))


@pytest.mark.parametrize(
    ("layout", "pattern", "key", "value", "message"),
    [
        ("packed", "packed/*/*/*.npz", "scan_n", None, "expected the keys scan_n"),
        ("packed", "packed/*/*/*.npz", "vtransf", np.tile(np.eye(3), (9, 1, 1)), "vtransf"),
        ("packed", "extra/*/*/*.npz", "mean_body_v", "rest", "mean_body_v: expected the pose of body_verts"),
        ("packed", "extra/*/*/*.npz", "body_pose", np.zeros((22, 3, 3)), "rotation matrices"),
        ("cape_raw", "sequences/*/*/*.npz", "pose", np.full(72, 90.0), "expected radians"),
        ("cape_raw", "sequences/*/*/*.npz", "transl", np.full(3, 900.0), "move of|translation"),
        ("fite", "data_scans/*/*/*.npz", "scan_f", np.full((9, 3), 9999), "indices"),
        ("fite", "data_scans/*/*/*.npz", "pose", np.zeros(71), "expected 66 or 72 or 156 or 165 numbers"),
        ("fite", "data_scans/*/*/*.npz", "transl", np.array([None] * 3), "Python objects"),
    ],
)
def test_files_that_do_not_hold_what_they_should_are_named(layout, pattern, key, value, message, change, person):
    config = change(layout)
    for path in config.source.glob(pattern):
        with np.load(path, allow_pickle=True) as stored:
            arrays = dict(stored) | {key: shaped(person) if isinstance(value, str) else value}
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(DataError, match=message) as caught:
        (convert if key in ("vtransf", "transl") else read)(config)
    assert str(config.source) in str(caught.value)


@pytest.mark.slow
def test_a_converted_outfit_is_trained_moved_and_meshed(originals, bodies, tmp_path):
    root = originals("scanimate")[0]
    config = ConvertConfig(source=root, body=SourceBody(path=bodies["smpl"]), data_root=tmp_path, name="coat")
    (outfit,) = convert(config)
    run = train(
        RunConfig(
            method=MethodChoice("closet", "closet", SETTINGS),
            dataset=config.dataset,
            outfit=("coat",),
            data_root=tmp_path,
            runs_root=tmp_path / "runs",
            train=quick_training(steps=4, points=500, scan_points=500),
        )
    )
    motion = authored_motion("walk", fps=30, seconds=0.04)
    (surface,) = Avatar(run).animate(motion, points=3000)
    hands = np.concatenate([motion.poses[0], np.zeros((2, 3))])
    body = outfit.fit_pose(hands, motion.translations[0]).vertices
    for points in (surface.cloud.points, to_mesh(surface.cloud, PoissonConfig(depth=7, max_hole=0.1)).vertices):
        assert cKDTree(body).query(points)[0].max() < 0.1 and cKDTree(points).query(body)[0].max() < 0.12
