"""Outfits on disk: the open layout, the packed layout, and finding them by name."""

import dataclasses
import shutil

import numpy as np
import pytest
import torch
import trimesh
import yaml
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from avatar.body.open import open_body
from avatar.body.packed import write_body, write_template
from avatar.checks import AvatarError, DataError
from avatar.data.folders import outfit_folder
from avatar.data.layouts import OpenOutfit, find_outfit, open_outfit_folder
from avatar.data.packed_layout import PackedOutfit, fit_joint_transforms, write_packed_frame, write_packed_outfit
from avatar.data.scanner import ScanConfig
from avatar.data.splits import split_outfit
from avatar.geometry.transforms import transform_points
from avatar.io.frames import check_manifest, read_open_frame, write_open_frame
from avatar.io.npz import write_arrays
from avatar.methods.canonicalizer import CanonicalizeConfig

FIT_KEYS = ("vertices", "vertex_transforms", "joint_transforms", "pose_vertices", "translation", "pose")
SCAN_KEYS = ("points", "normals", "labels", "canonical")


@pytest.fixture
def copy(tiny_folder, tmp_path):
    """A copy of the tiny outfit that a test may spoil."""
    return shutil.copytree(tiny_folder, tmp_path / "open" / "tiny")


@pytest.fixture(scope="module")
def packed_folder(tiny_outfit, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "resynth" / "tiny"
    write_packed_outfit(tiny_outfit, folder)
    return folder


@pytest.fixture
def packed(packed_folder, tmp_path):
    """A copy of the packed tiny outfit, and its first frame's arrays."""
    folder = shutil.copytree(packed_folder, tmp_path / "tiny")
    with np.load(folder / "train" / "rise.00003.npz", allow_pickle=False) as stored:
        return folder, dict(stored)


def reload(folder, arrays):
    """The spoiled first frame of a packed outfit."""
    write_arrays(folder / "train" / "rise.00003.npz", arrays)
    return PackedOutfit(folder).load("train", "rise.00003")


def test_an_open_outfit_knows_its_frames_and_body(tiny_outfit):
    assert tiny_outfit.frames("train") == tuple(f"rise.{i:05d}" for i in range(6))
    assert tiny_outfit.frames("test") == tuple(f"check.{i:05d}" for i in range(3))
    assert (tiny_outfit.name, tiny_outfit.dataset) == ("tiny", "open")
    torch.testing.assert_close(tiny_outfit.template.vertices, open_body("female").template.vertices)


def test_a_loaded_frame_is_the_posed_body_and_its_scan(tiny_outfit):
    frame = tiny_outfit.load("train", "rise.00003")
    fit, template = frame.body, tiny_outfit.template
    assert (frame.name, frame.outfit, frame.split) == ("rise.00003", "tiny", "train")
    carried = transform_points(torch.from_numpy(fit.vertex_transforms), template.vertices)
    np.testing.assert_allclose(carried.numpy(), fit.vertices, atol=1e-5)
    posed = open_body("female")(torch.from_numpy(fit.pose)[None], torch.from_numpy(fit.translation)[None])
    np.testing.assert_allclose(posed.vertices[0].numpy(), fit.vertices, atol=1e-6)
    assert frame.scan.points.shape == (4000, 3)
    assert set(np.unique(frame.scan.labels)) == {0, 1, 2}


def test_canonical_truth_is_the_scan_unposed(tiny_outfit):
    """In the first frame the garment does not bulge: carrying each truth as its nearest vertex gives its point."""
    frame = tiny_outfit.load("train", "rise.00000")
    _, nearest = cKDTree(tiny_outfit.template.vertices.numpy()).query(frame.scan.canonical)
    carrying = torch.from_numpy(frame.body.vertex_transforms[nearest])
    carried = transform_points(carrying, torch.from_numpy(frame.scan.canonical)).numpy()
    off = np.linalg.norm(carried - frame.scan.points, axis=1)
    assert np.median(off) < 1e-3
    assert off.max() < 0.04


def test_what_a_pose_encoder_sees_has_neither_root_nor_shape(tiny_outfit):
    pose = tiny_outfit.load("train", "rise.00004").body.pose.copy()
    still = tiny_outfit.fit_pose(pose)
    pose[0] = [0.1, 1.2, -0.3]
    turned = tiny_outfit.fit_pose(pose, np.array([1.0, 2.0, 3.0], np.float32))
    np.testing.assert_allclose(turned.pose_vertices, still.pose_vertices, atol=1e-6)
    assert np.abs(turned.vertices - still.vertices).max() > 1
    other = open_body("male")(torch.from_numpy(pose * (np.arange(22) > 0)[:, None])[None])
    female = open_body("female")(torch.from_numpy(pose * (np.arange(22) > 0)[:, None])[None])
    between = (other.vertices + female.vertices)[0].numpy() / 2
    assert np.abs(still.pose_vertices - between).max() < 0.02  # the mean shape lies amid the shapes
    with pytest.raises(AvatarError, match="pose: expected shape"):
        tiny_outfit.fit_pose(pose[:21])


def test_resampling_is_fresh_perfect_and_repeatable(tiny_folder):
    raw = OpenOutfit(tiny_folder, "open", ScanConfig(points=2000, noise=0.01, holes=3))
    scan = raw.load("test", "check.00001").scan
    first, again = (raw.resample("test", "check.00001", 2000, seed=0) for _ in range(2))
    np.testing.assert_array_equal(first.points, again.points)
    assert len(first.points) == 2000 > len(scan.points)
    assert (first.points != raw.resample("test", "check.00001", 2000, seed=1).points).any()
    perfect = OpenOutfit(tiny_folder, "open", ScanConfig(points=2000)).load("test", "check.00001").scan
    assert (first.points != perfect.points).all()  # independent of the scan even for the same seed
    mesh = raw.load_mesh("test", "check.00001")
    distance, nearest = cKDTree(mesh.points).query(first.points)
    across = ((first.points - mesh.points[nearest]) * mesh.normals[nearest]).sum(axis=1)
    assert distance.max() < 0.05
    assert np.median(np.abs(across)) < 1e-3  # on the surface, where noise would be 10 mm


def test_legs_apart_is_another_canonical_space(copy):
    settings = yaml.safe_load((copy / "outfit.yaml").read_text())
    settings["body"]["canonical"] = "apart"
    (copy / "outfit.yaml").write_text(yaml.safe_dump(settings))
    apart, straight = OpenOutfit(copy), open_body("female").template
    places = apart.template.vertices.numpy()
    assert np.ptp(places[places[:, 1] < -0.4, 0]) > 1.0
    pose = straight.vertices.new_zeros(22, 3).numpy()
    np.testing.assert_allclose(apart.fit_pose(pose).vertices, straight.vertices, atol=1e-5)


def test_a_subject_may_come_from_a_file(copy, tiny_outfit):
    """As tools/simulate.py shapes=[tall.npz] leaves it; a body of another topology is refused."""
    text = (copy / "outfit.yaml").read_text()
    (copy / "outfit.yaml").write_text(text.replace("model: open", "model: packed"))
    write_body(copy / "body.npz", open_body("male"))
    outfit = OpenOutfit(copy)
    torch.testing.assert_close(outfit.template.vertices, open_body("male").template.vertices, atol=1e-6, rtol=0)
    ours, theirs = outfit.load_body("train", "rise.00003"), tiny_outfit.load_body("train", "rise.00003")
    np.testing.assert_allclose(ours.pose_vertices, theirs.pose_vertices, atol=1e-6)
    cut = open_body("male").template
    write_template(copy / "body.npz", dataclasses.replace(cut, faces=cut.faces[:-1], uv=None, uv_faces=None))
    with pytest.raises(DataError, match="make_body"):
        OpenOutfit(copy).load_body("train", "rise.00003")


def test_packing_loses_nothing(tiny_outfit, packed_folder):
    packed = open_outfit_folder(packed_folder)
    check_manifest(packed_folder, verify_hashes=True)
    assert isinstance(packed, PackedOutfit)
    for key in ("vertices", "weights", "joints"):
        torch.testing.assert_close(getattr(packed.template, key), getattr(tiny_outfit.template, key), atol=1e-6, rtol=0)
    for split in ("train", "test"):
        assert packed.frames(split) == tiny_outfit.frames(split)
    for split, name in (("train", "rise.00005"), ("test", "check.00000")):
        ours, theirs = tiny_outfit.load(split, name), packed.load(split, name)
        assert (theirs.name, theirs.outfit, theirs.split) == (ours.name, "tiny", ours.split)
        for key in FIT_KEYS:
            np.testing.assert_allclose(getattr(theirs.body, key), getattr(ours.body, key), atol=1e-5)
        for key in SCAN_KEYS:
            np.testing.assert_allclose(getattr(theirs.scan, key), getattr(ours.scan, key), atol=1e-5)


@pytest.mark.parametrize(
    "kept",
    [
        ("body_verts", "vtransf"),
        ("body_verts", "joint_transforms"),
        ("vtransf",),
        ("joint_transforms",),
        ("pose", "translation"),
        ("body_verts", "rotations"),
    ],
)
def test_what_a_frame_lacks_is_derived(packed, kept):
    folder, stored = packed
    fit = PackedOutfit(folder).fit_pose(stored["pose"], stored["translation"])  # skinned from the T-pose, as SMPL is
    known = {"body_verts": fit.vertices, "vtransf": fit.vertex_transforms, "joint_transforms": fit.joint_transforms}
    arrays = {**stored, **known, "rotations": fit.vertex_transforms}
    reduced = {key: arrays[key] for key in ("scan_pc", "scan_n", *kept)}
    if "rotations" in reduced:
        reduced["vtransf"] = reduced.pop("rotations")[:, :3, :3]
    reduced["posmap128"] = np.full((4, 4, 3), np.nan)
    fit = reload(folder, reduced).body
    for key, known in (
        ("vertices", "body_verts"),
        ("vertex_transforms", "vtransf"),
        ("joint_transforms", "joint_transforms"),
    ):
        np.testing.assert_allclose(getattr(fit, key), arrays[known], atol=2e-4, err_msg=key)
    root = torch.linalg.inv(torch.from_numpy(arrays["joint_transforms"][0]))
    seen = transform_points(root, torch.from_numpy(arrays["body_verts"])).numpy()
    if "pose" in kept:  # then the mean body is seen in it
        seen = arrays["pose_vertices"]
    np.testing.assert_allclose(fit.pose_vertices, seen, atol=2e-4)


@pytest.mark.parametrize("write", [write_body, lambda path, body: write_template(path, body.template)])
def test_joint_transforms_of_a_body_bound_in_an_a_pose_follow_from_vtransf(tiny_outfit, tmp_path, write):
    """Weights blend motions from the bind pose, not from rest: blended from rest, collars are 20 degrees off."""
    known = tiny_outfit.load("train", "rise.00005")
    write(tmp_path / "template.npz", tiny_outfit.body)
    (tmp_path / "train").mkdir()
    keys = {"vtransf": known.body.vertex_transforms, "body_verts": known.body.vertices}
    np.savez(tmp_path / "train" / "a.npz", scan_pc=known.scan.points, scan_n=known.scan.normals, **keys)
    found = PackedOutfit(tmp_path).load("train", "a").body
    np.testing.assert_allclose(found.joint_transforms, known.body.joint_transforms, atol=2e-4)
    posed = PackedOutfit(tmp_path).fit_pose(known.body.pose, known.body.translation)
    np.testing.assert_allclose(posed.vertices, known.body.vertices, atol=2e-5)


def test_joint_transforms_are_recovered_by_least_squares():
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.full(5, 0.3), size=200).astype(np.float32)
    weights[:, 4] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    true = np.tile(np.eye(4), (5, 1, 1))
    true[:, :3, :3] = Rotation.random(5, rng=rng).as_matrix()
    true[:, :3, 3] = rng.normal(size=(5, 3))
    true[4] = true[1]  # no vertex follows it: it moves with its parent
    blended = np.einsum("vj,jab->vab", weights, true)
    found = fit_joint_transforms(blended, weights, (-1, 0, 1, 2, 1))
    np.testing.assert_allclose(found, true, atol=1e-4)
    mirrored = np.tile(np.diag([-1.0, 1.02, 0.98, 1.0]), (200, 1, 1))
    assert np.linalg.det(fit_joint_transforms(mirrored, weights, (-1, 0, 1, 2, 1))[:, :3, :3]) == pytest.approx(1)


def test_pop_files_with_a_mesh_template_are_read_as_they_are(packed):
    folder, arrays = packed
    mesh = open_body("female").template
    (folder / "template.npz").unlink()
    trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False).export(folder / "template.obj")
    (folder / "outfit.yaml").unlink()
    pop = {"body_verts": arrays["body_verts"], "vtransf": arrays["vtransf"][:, :3, :3]}
    pop |= {"scan_pc": arrays["scan_pc"], "scan_n": arrays["scan_n"], "scan_name": np.array("rise.00003")}
    frame = reload(folder, pop)
    np.testing.assert_allclose(frame.body.pose_vertices, arrays["body_verts"], atol=1e-6)
    np.testing.assert_allclose(frame.body.vertex_transforms, arrays["vtransf"], atol=1e-5)
    outfit = open_outfit_folder(folder)
    assert outfit.template.weights.shape == (12272, 1)
    with pytest.raises(DataError, match="posing needs skinning weights"):
        outfit.fit_pose(arrays["pose"])
    with pytest.raises(DataError, match="expected body_verts and vtransf"):
        reload(folder, {key: arrays[key] for key in ("scan_pc", "scan_n", "pose")})
    (folder / "template.obj").unlink()
    with pytest.raises(DataError, match=r"template\.npz or template\.obj"):
        _ = PackedOutfit(folder).template


def test_a_mesh_template_brings_its_uv_atlas_where_it_is_unwrapped(packed):
    folder, _ = packed
    body = open_body("female").template
    (folder / "template.npz").unlink()
    (folder / "outfit.yaml").unlink()
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in body.vertices.tolist()]
    lines += [f"vt {u:.9f} {v:.9f}" for u, v in body.uv.tolist()]
    for face, corners in zip(body.faces.tolist(), body.uv_faces.tolist()):
        lines.append("f " + " ".join(f"{v + 1}/{c + 1}" for v, c in zip(face, corners)))
    (folder / "template.obj").write_text("\n".join(lines))
    template = PackedOutfit(folder).template
    torch.testing.assert_close(template.uv[template.uv_faces], body.uv[body.uv_faces])
    torch.testing.assert_close(template.faces, body.faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scan_pc": lambda a: a * 100}, "scan: expected about .* looks like centimetres: divide .* by 100"),
        ({"scan_pc": lambda a: a * 1000}, "scan: .* looks like millimetres"),
        ({"body_verts": lambda a: a * 100}, "body: expected about .* looks like centimetres"),
        ({"scan_pc": lambda a: a + [0, 3, 0]}, r"expected it over its body.*Moving it by \(.*, -(2\.9|3\.0)\d, "),
        ({"scan_pc": lambda a: a[:, [0, 2, 1]]}, "expected it over its body.*Swapping y and z of the scan"),
        ({"scan_n": lambda a: -a}, "multiply its normals by -1"),
        ({"pose": lambda a: np.tile(np.eye(3), (22, 1, 1))}, r"expected shape \(22, 3\).*These are rotation matrices"),
        ({"pose": lambda a: np.zeros(72)}, r"It has 24 joints"),
        ({"pose": lambda a: np.rad2deg(a)}, "looks like degrees"),
        ({"scan_colors": lambda _: np.full((4000, 3), 200.0)}, r"colours from 0 to 1, got 200 to 200\. Store them as"),
        ({"scan_pc": lambda a: a[:0], "scan_n": lambda a: a[:0]}, "at least 100 points, got 0"),
        ({"scan_pc": lambda a: a * np.nan}, "scan_pc: expected finite"),
        ({"scan_n": lambda a: a[:-1]}, r"scan_n: expected shape \(M, 3\) with M=4000"),
        ({"scan_n": lambda a: a * 0}, "scan normals: expected unit length"),
        ({"body_verts": lambda a: a[:100], "vtransf": lambda a: a[:100]}, "expected 12272 rows as in the template"),
        ({"scan_faces": lambda _: np.array([[0, 1, 4000]])}, r"scan_faces: expected indices in \[0, 4000\)"),
        ({"scan_pc": None}, "expected the keys scan_pc, found only"),
        ({"vtransf": None, "joint_transforms": None, "pose": None}, "expected vtransf, joint_transforms or pose"),
    ],
)
def test_unsound_frames_are_one_error_that_names_the_file(packed, change, message):
    folder, arrays = packed
    arrays = {
        key: value for key, value in arrays.items() if key not in ("scan_labels", "scan_canonical", "pose_vertices")
    }
    for key, how in change.items():
        if how is None:
            del arrays[key]
        else:
            arrays[key] = how(arrays.get(key))
    with pytest.raises(DataError, match=message) as caught:
        reload(folder, arrays)
    assert "rise.00003.npz" in str(caught.value)


def test_a_template_in_centimetres_is_refused(packed):
    folder, _ = packed
    template = open_body("female").template
    large = dataclasses.replace(template, vertices=template.vertices * 100, joints=template.joints * 100)
    write_template(folder / "template.npz", large)
    with pytest.raises(DataError, match=r"0\.5 to 2\.5 m high, got 176\..*divide positions"):
        _ = PackedOutfit(folder).template


def test_frames_of_another_garment_are_refused(copy):
    frame = read_open_frame(copy / "train" / "rise.00000.npz")
    write_open_frame(copy / "train" / "rise.00000.npz", dataclasses.replace(frame, cloth=frame.cloth[:-1]))
    with pytest.raises(DataError, match=r"rise\.00000\.npz: cloth: expected .* garment.npz"):
        OpenOutfit(copy).load("train", "rise.00000")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("body: {model: smplx, shape: x}", "expected {model: open"),
        ("body: {model: open, shape: tall}", "shape: expected one of female"),
        ("body: {model: open, shape: female, canonical: sitting}", "canonical pose: expected one of t, apart"),
        ("- a\n- b", "expected a mapping"),
        ("a: [", "expected plain YAML"),
        ("!!python/object/apply:os.system ['true']", "expected plain YAML"),
        ("format: outfit/9", "expected format outfit/1, got outfit/9"),
        ("layout: cubes", "layout: expected one of open, packed"),
    ],
)
def test_a_wrong_outfit_file_is_one_error(copy, text, message):
    (copy / "outfit.yaml").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        _ = open_outfit_folder(copy).template
    assert "outfit.yaml" in str(caught.value)


def test_outfits_are_found_by_name(tiny_folder):
    root = tiny_folder.parents[1]
    outfit = find_outfit(root, "open", "tiny", ScanConfig(points=300))
    assert isinstance(outfit, OpenOutfit)
    assert (outfit.dataset, outfit.name) == ("open", "tiny")
    assert len(outfit.load("train", "rise.00000").scan.points) == 300
    with pytest.raises(DataError, match=r"no such outfit\. Did you mean 'tiny'\? There are: tiny"):
        find_outfit(root, "open", "tinny")
    with pytest.raises(DataError, match="expected the folder of data set cape"):
        find_outfit(root, "cape", "tiny")
    with pytest.raises(AvatarError, match="split: expected train, test or interpolation"):
        outfit.frames("val")
    with pytest.raises(AvatarError, match=r"no train frame 'rise\.00009'; there are rise"):
        outfit.load("train", "rise.00009")
    with pytest.raises(AvatarError, match="no train frame"):
        outfit.load("train", "../test/check.00000")


def test_pop_nesting_and_the_embedded_sample_are_found(tiny_folder, tmp_path, monkeypatch):
    shutil.copytree(tiny_folder, tmp_path / "resynth" / "packed" / "tiny")
    assert outfit_folder(tmp_path, "resynth", "tiny") == tmp_path / "resynth" / "packed" / "tiny"
    monkeypatch.setattr("avatar.data.folders.SAMPLE_FOLDER", tiny_folder.parent)
    assert find_outfit(tmp_path / "nowhere", "sample", "tiny").path == tiny_folder


@pytest.mark.parametrize("name", ["../open", "/etc", "a/b", "", ".hidden", "a\0b", "x" * 65, "~", "C:\\x", "naïve"])
def test_names_that_could_leave_the_root_are_refused(tiny_folder, name):
    root = tiny_folder.parents[1]
    for dataset, outfit in ((name, "tiny"), ("open", name)):
        with pytest.raises(AvatarError, match="expected a plain name"):
            find_outfit(root, dataset, outfit)


def test_links_out_of_the_root_are_refused(tiny_folder, tmp_path):
    (tmp_path / "open").mkdir()
    (tmp_path / "open" / "tiny").symlink_to(tiny_folder)
    with pytest.raises(DataError, match="it is a link to"):
        find_outfit(tmp_path, "open", "tiny")


@pytest.mark.parametrize("emptied", [True, False])
def test_data_without_test_frames_train_and_canonicalize(copy, emptied):
    """A test folder may be missing, or there and empty."""
    shutil.rmtree(copy / "test")
    if emptied:
        (copy / "test").mkdir()
    outfit = OpenOutfit(copy)
    assert (outfit.has_frames("train"), outfit.has_frames("test")) == (True, False)
    assert len(split_outfit(outfit).train) == 5
    config = CanonicalizeConfig(dataset="open", outfit="tiny", data_root=copy.parents[1])
    assert {where.split for where in config.frames().names} == {"train"}


def test_empty_splits_are_one_error(copy):
    for path in (copy / "test").glob("*.npz"):
        path.unlink()
    with pytest.raises(DataError, match=r"expected frames \(\*\.npz\), found none"):
        OpenOutfit(copy).frames("test")


def test_a_mesh_scan_is_packed_with_its_faces(tiny_outfit, packed):
    folder, _ = packed
    frame = tiny_outfit.load("train", "rise.00003")
    meshed = dataclasses.replace(frame, scan=tiny_outfit.load_mesh("train", "rise.00003"))
    write_packed_frame(folder / "train" / "rise.00003.npz", meshed)
    read = PackedOutfit(folder).load("train", "rise.00003").scan
    np.testing.assert_array_equal(read.faces, meshed.scan.faces)
    np.testing.assert_allclose(read.points, meshed.scan.points, atol=1e-6)


def test_colours_are_packed_to_8_bits_and_read_as_bytes_or_floats(tiny_outfit, packed):
    folder, stored = packed
    assert PackedOutfit(folder).load("train", "rise.00003").scan.colors is None
    colors = np.random.default_rng(0).random((4000, 3), np.float32)
    frame = tiny_outfit.load("train", "rise.00003")
    colored = dataclasses.replace(frame, scan=dataclasses.replace(frame.scan, colors=colors))
    write_packed_frame(folder / "train" / "rise.00003.npz", colored)
    read = PackedOutfit(folder).load("train", "rise.00003").scan.colors
    assert read.dtype == np.float32
    np.testing.assert_allclose(read, colors, atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(reload(folder, {**stored, "scan_colors": colors}).scan.colors, colors)


def test_the_body_of_a_frame_is_known_without_its_scan(tiny_outfit):
    fit, known = tiny_outfit.load_body("train", "rise.00003"), tiny_outfit.load("train", "rise.00003").body
    for key in FIT_KEYS:
        np.testing.assert_array_equal(getattr(fit, key), getattr(known, key))


def test_a_pose_to_fit_must_be_axis_angle(tiny_outfit):
    with pytest.raises(AvatarError, match="These are rotation matrices"):
        tiny_outfit.fit_pose(np.tile(np.eye(3, dtype=np.float32), (22, 1, 1)))
    with pytest.raises(AvatarError, match=r"It is flat: pose\.reshape\(22, 3\)"):
        tiny_outfit.fit_pose(np.zeros(66, np.float32))
