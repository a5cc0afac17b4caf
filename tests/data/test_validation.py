"""Refusals: every mistake users make with their own scans is named, with what would hint it; valid data passes."""

import dataclasses
import re
import time

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from avatar.body.open import open_body
from avatar.checks import AvatarError, DataError
from avatar.data.alignment import measure_overlap, suggest_hint
from avatar.data.layouts import find_outfit
from avatar.data.scan_validation import check_frame
from avatar.data.scanner import SCANNERS
from avatar.data.validation import (
    check_frame_count,
    check_pose,
    check_template,
)
from avatar.geometry.surface import vertex_normals
from avatar.records import BodyFit, Frame, Scan

BODY = open_body("female")
CRAWL = {"left_hip": [-1.4, 0, 0], "right_hip": [-1.2, 0, 0.1], "left_knee": [1.5, 0, 0], "right_knee": [1.2, 0, 0],
         "left_shoulder": [0, -1.3, 0.1], "right_shoulder": [0, 1.2, -0.3], "left_elbow": [0, -0.4, 0]}  # fmt: skip


def person(pose, translation=(0.0, 0.0, 0.0), ease=0.01, flare=0.0):
    """A frame: the body in a pose, in clothes that stand off by the ease, and by more from the hips down."""
    pose = torch.as_tensor(pose, dtype=torch.float32)[None]
    posed = BODY(pose, torch.tensor([translation], dtype=torch.float32))
    vertices, template = posed.vertices[0], BODY.template
    normals = vertex_normals(vertices, template.faces)
    below = (0.1 - template.vertices[:, 1:2]).clamp(0, 0.6) * (template.vertices[:, :1].abs() < 0.3)
    points = vertices + (ease + flare * below) * normals
    points = points + 0.0015 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    fit = BodyFit(
        vertices=vertices.numpy(),
        vertex_transforms=posed.vertex_transforms[0].numpy(),
        joint_transforms=posed.joint_transforms[0].numpy(),
        pose_vertices=vertices.numpy(),
        translation=np.zeros(3, np.float32),
        pose=pose[0].numpy(),
    )
    return Frame("a.0", "own", "train", fit, Scan(points.numpy(), normals.numpy(), template.faces.numpy()))


def turned(frame, linear, shift=(0.0, 0.0, 0.0)):
    """The frame with its scan turned and moved, its body left."""
    linear = np.asarray(linear, float)
    scan = frame.scan
    moved = dataclasses.replace(scan, points=scan.points @ linear.T + np.array(shift), normals=scan.normals @ linear.T)
    return dataclasses.replace(frame, scan=moved)


def named_pose(turns):
    pose = np.zeros((22, 3), np.float32)
    for name, turn in turns.items():
        pose[BODY.joint_names.index(name)] = turn
    return pose


def lopsided():
    """A pose that no mirror leaves alone."""
    pose = np.zeros((22, 3), np.float32)
    for name, turn in {
        "left_shoulder": [0, 0, -1.2],
        "right_shoulder": [0, 0.8, 0.6],
        "left_hip": [-1.0, 0, 0],
    }.items():
        pose[BODY.joint_names.index(name)] = turn
    return pose


def turn_about(axis, degrees):
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


WRONG_PLACES = {
    "a fit in another place": (
        (np.eye(3), (0.3, 0.1, -0.2)),
        r"Moving it by \(-0\.(29|3\d), -0\.(09|1\d), 0\.(19|2\d)\) m",
    ),
    "a scan with z up": ((turn_about("x", 90), (0, 0, 0)), "Turning the scan by -90 degrees about x would"),
    "a scan with z down": ((turn_about("x", -90), (0, 0, 0)), "Turning the scan by 90 degrees about x would"),
    "a scan upside down": ((turn_about("z", 180), (0, 0, 0)), "Turning the scan by 180 degrees about z"),
    "a scan with y down": ((np.diag([1, -1, 1]), (0, 0, 0)), r"Mirroring the scan \(y to -y\)"),
    "a scan from behind": ((turn_about("y", 180), (0, 0, 0)), "Turning the scan by 180 degrees about y"),
    "a scan from the side": ((turn_about("y", -90), (0, 0, 0)), "Turning the scan by 90 degrees about y"),
    "a mirrored scan": ((np.diag([-1, 1, 1]), (0, 0, 0)), r"Mirroring the scan \(x to -x\)"),
    "y and z swapped": ((np.eye(3)[[0, 2, 1]], (0, 0, 0)), "Swapping y and z of the scan"),
    "turned and moved": ((turn_about("x", 90), (0, 1.0, 0.5)), "Turning the scan by -90 degrees about x and moving it"),
    "a translation in millimetres": ((np.eye(3), (0, 900.0, 2500.0)), "is the translation in metres"),
}


@pytest.mark.parametrize("case", WRONG_PLACES)
def test_a_scan_that_is_not_over_its_body_is_refused_with_the_mend(case, tmp_path):
    (linear, shift), message = WRONG_PLACES[case]
    frame = turned(person(lopsided()), linear, shift)
    with pytest.raises(DataError, match="expected it over its body") as caught:
        check_frame(frame, BODY.template, tmp_path / "a.0.npz")
    assert "a.0.npz" in str(caught.value)
    with pytest.raises(DataError, match=message):
        check_frame(frame, BODY.template, tmp_path / "a.0.npz")


def test_overlap_tells_shares_of_skin_of_points_and_of_normals():
    ball = trimesh.creation.icosphere(4, 0.3)
    normals = np.array(ball.vertex_normals)
    height = np.where(np.arange(len(normals)) % 4 == 0, -0.05, 0.02)[:, None]  # every fourth point is 5 cm deep
    points = ball.vertices + height * normals
    seen = measure_overlap(points, normals, ball.vertices, ball.faces)
    assert (seen.covered, seen.outward) == (1, 1)
    assert seen.buried == pytest.approx(0.25, abs=0.05)
    top = points[:, 1] > 0.1
    half = measure_overlap(points[top], -normals[top], ball.vertices, ball.faces)
    assert half.outward == 0
    assert 0.34 < half.covered < 0.6  # a cap of a third, and 10 cm around it


def test_a_scan_too_deep_in_its_body_or_of_too_little_of_it_is_refused(tmp_path):
    frame = person(lopsided())
    sunk = dataclasses.replace(frame.scan, points=frame.scan.points - 0.05 * frame.scan.normals)
    with pytest.raises(DataError, match=r"[2-9]\d% of the scan lies deep inside\. Neither"):
        check_frame(dataclasses.replace(frame, scan=sunk), BODY.template, tmp_path)
    lower = frame.scan.points[:, 1] < np.quantile(frame.body.vertices[:, 1], 0.3)
    part = {"points": frame.scan.points[lower], "normals": frame.scan.normals[lower], "faces": None}
    with pytest.raises(DataError, match=r"[2-5]\d% of the body has a scan point"):
        check_frame(dataclasses.replace(frame, scan=dataclasses.replace(frame.scan, **part)), BODY.template, tmp_path)


def test_the_mend_that_is_named_mends(tmp_path):
    frame = turned(person(lopsided()), turn_about("x", 90), (0, 1.0, 0.5))
    points, body, faces = frame.scan.points, frame.body.vertices, BODY.template.faces.numpy()
    words = suggest_hint(points, frame.scan.normals, body, faces)
    shift = np.array([float(number) for number in words.split("(")[1].split(")")[0].split(",")])
    moved = points @ turn_about("x", -90).T + shift
    normals = frame.scan.normals @ turn_about("x", -90).T
    assert measure_overlap(moved, normals, body, faces).covered > 0.95


def test_the_fit_of_another_frame_is_refused(tmp_path):
    ours, other = person(lopsided()), person(np.zeros((22, 3)))
    with pytest.raises(DataError, match="is the fit of another frame or person"):
        check_frame(dataclasses.replace(ours, body=other.body), BODY.template, tmp_path)


@pytest.mark.parametrize(
    ("factor", "message"),
    [(100, "centimetres: divide .* by 100"), (1000, "millimetres: divide .* 0.001"), (0.001, "multiply .* by 1000")],
)
@pytest.mark.parametrize("what", ["scan", "body"])
def test_other_units_are_refused_with_their_factor(what, factor, message, tmp_path):
    frame = person(lopsided())
    if what == "scan":
        frame = dataclasses.replace(frame, scan=dataclasses.replace(frame.scan, points=frame.scan.points * factor))
    else:
        fit = dataclasses.replace(frame.body, vertices=frame.body.vertices * factor)
        frame = dataclasses.replace(frame, body=fit)
    with pytest.raises(DataError, match=f"{what}: expected about .*{message}"):
        check_frame(frame, BODY.template, tmp_path)


def spoil_normals(scan, how):
    flips = np.where(np.random.default_rng(0).random(len(scan.normals)) < 0.5, 1, -1)[:, None]
    return {
        "inside out": lambda: dataclasses.replace(scan, normals=-scan.normals),
        "either way": lambda: dataclasses.replace(scan, normals=scan.normals * flips),
        "wound the other way": lambda: dataclasses.replace(scan, faces=scan.faces[:, ::-1]),
    }[how]()


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("inside out", r"\d\d\d?% point into the body.*multiply its normals by -1"),
        ("either way", r"only \d\d% do.*Orient them"),
        ("wound the other way", "counter-clockwise from outside.*scan is mirrored.*wound inward .swap two"),
    ],
)
def test_normals_and_faces_that_point_the_wrong_way_are_refused(how, message, tmp_path):
    frame = person(lopsided())
    with pytest.raises(DataError, match=message):
        check_frame(dataclasses.replace(frame, scan=spoil_normals(frame.scan, how)), BODY.template, tmp_path)


POSE = np.zeros((22, 3), np.float32)
WRONG_POSES = {
    "rotation matrices": (np.tile(np.eye(3), (22, 1, 1)), r"rotation matrices: .*from_matrix\(pose\)\.as_rotvec"),
    "quaternions": (np.tile([0.0, 0, 0, 1], (22, 1)), r"quaternions: .*from_quat"),
    "flat": (POSE.reshape(66), r"It is flat: pose\.reshape\(22, 3\)"),
    "SMPL's 72 numbers": (np.zeros(72), r"It has 24 joints.*pose\.reshape\(24, 3\)\[:22\]"),
    "SMPL's 24 joints": (np.zeros((24, 3)), r"It has 24 joints.*pose\[:22\]"),
    "SMPL-X's 165 numbers": (np.zeros((1, 165)), r"It has 55 joints.*pose\.reshape\(55, 3\)\[:22\]"),
    "6D": (np.zeros((22, 6)), "6D rotations"),
    "too few joints": (POSE[:21], r"expected shape \(22, 3\).*got \(21, 3\)"),
    "degrees": (POSE + np.float32([40, 0, 0]), r"joint 0 turns by 40.*degrees: multiply by pi / 180"),
    "not finite": (POSE * np.nan, "pose: expected finite numbers"),
}


@pytest.mark.parametrize("case", WRONG_POSES)
def test_a_pose_written_another_way_is_refused_with_the_conversion(case):
    pose, message = WRONG_POSES[case]
    with pytest.raises(AvatarError, match=message):
        check_pose(pose, 22)


def test_sound_poses_pass_and_the_matrix_hint_is_right():
    check_pose(POSE, 22)
    pose = Rotation.random(22, random_state=0).as_rotvec()
    check_pose(pose, 22)
    np.testing.assert_allclose(Rotation.from_matrix(Rotation.from_rotvec(pose).as_matrix()).as_rotvec(), pose)


def turned_template(linear):
    linear = torch.as_tensor(np.asarray(linear), dtype=torch.float32)
    template = BODY.template
    return dataclasses.replace(template, vertices=template.vertices @ linear.T, joints=template.joints @ linear.T)


@pytest.mark.parametrize(
    ("linear", "message"),
    [
        (turn_about("x", 90), r"neck towards \+y from pelvis, it lies towards \+z.*-90 degrees about x"),
        (turn_about("x", -90), r"towards -z.* by 90 degrees about x"),
        (turn_about("z", 180), r"towards -y.*180 degrees about z"),
        (turn_about("z", 90), r"towards -x.*-90 degrees about z"),
        (turn_about("z", -90), r"towards \+x.* by 90 degrees about z"),
        (turn_about("y", 180), r"left_hip towards \+x from right_hip, it lies towards -x.*faces -z"),
        (turn_about("y", 90), r"towards -z.* by -90 degrees about y"),
        (turn_about("y", -90), r"towards \+z.* by 90 degrees about y"),
        (np.diag([-1, 1, 1]), "towards -x.*mirrored"),
        (np.eye(3) * 100, "176.*centimetres"),
        (np.eye(3) * 0.001, "multiply positions and translations by 1000"),
    ],
)
def test_a_template_that_does_not_stand_upright_in_metres_is_refused(linear, message, tmp_path):
    with pytest.raises(DataError, match=message):
        check_template(turned_template(linear), tmp_path)


def test_the_turns_that_are_named_for_a_template_mend_it(tmp_path):
    """(x, y, z) to (x, z, -y) and its like, read from the message and applied."""
    for axis, degrees in (("x", 90), ("x", -90), ("z", 180), ("z", 90), ("z", -90), ("y", 90), ("y", -90)):
        template = turned_template(turn_about(axis, degrees))
        with pytest.raises(DataError) as caught:
            check_template(template, tmp_path)
        entries = str(caught.value).rpartition(" to (")[2].partition(")")[0].split(", ")
        hint = torch.zeros(3, 3)
        for row, entry in enumerate(entries):
            hint[row, "xyz".index(entry[-1])] = -1 if entry.startswith("-") else 1
        moved = dataclasses.replace(template, vertices=template.vertices @ hint.T, joints=template.joints @ hint.T)
        check_template(moved, tmp_path)
        torch.testing.assert_close(moved.vertices, BODY.template.vertices, atol=1e-5, rtol=0)


def test_a_template_without_known_joints_is_judged_by_its_shape(tmp_path):
    plain = turned_template(np.eye(3))
    one = {"joint_names": ("root",), "joints": torch.zeros(1, 3), "parents": plain.parents[:1]}
    plain = dataclasses.replace(plain, weights=torch.ones(len(plain.vertices), 1), **one)
    check_template(plain, tmp_path)
    lying = dataclasses.replace(plain, vertices=turned_template(turn_about("x", 90)).vertices)
    with pytest.raises(DataError, match=r"stands along y.*-90 degrees about x"):
        check_template(lying, tmp_path)


def test_one_frame_is_too_few(tmp_path):
    with pytest.raises(DataError, match=r"the canonicalizer needs at least 2 frames .* there is 1 \(a\.0\).*add scans"):
        check_frame_count(["a.0", "a.0"], tmp_path, "the canonicalizer")
    with pytest.raises(DataError, match="there is none"):
        check_frame_count([], tmp_path, "training")
    check_frame_count(["a.0", "a.1"], tmp_path, "training")


@pytest.mark.parametrize(
    "turns",
    [
        {},
        CRAWL,
        {"pelvis": [1.5, 0, 0], **CRAWL},  # on hands and knees
        {"pelvis": [0, 2.5, 0], "spine1": [0.7, 0, 0], "spine2": [0.6, 0, 0]},  # a deep bend, seen from behind
        {"pelvis": [0, 0, np.pi]},  # a handstand
    ],
)
@pytest.mark.parametrize(("ease", "flare"), [(0.003, 0.0), (0.03, 0.0), (0.02, 0.25)])
def test_sound_frames_in_any_pose_pass(turns, ease, flare, tmp_path):
    frame = person(named_pose(turns), (0.4, 0.9, -1.0), ease, flare)
    check_frame(frame, BODY.template, tmp_path)
    sparse = dataclasses.replace(
        frame.scan, points=frame.scan.points[::90], normals=frame.scan.normals[::90], faces=None
    )
    check_frame(dataclasses.replace(frame, scan=sparse), BODY.template, tmp_path)


@pytest.mark.parametrize("scanner", SCANNERS)
def test_the_sample_passes_without_a_doubt_whatever_the_scanner(scanner, caplog):
    dress = find_outfit("nowhere", "sample", "dress", SCANNERS[scanner])
    bend = dress.frames("test")[0]
    assert dress.load("test", bend).name == bend and caplog.text == ""


def test_the_checks_are_cheap(tmp_path):
    frame = person(lopsided())
    check_frame(frame, BODY.template, tmp_path)
    start = time.process_time()
    for _ in range(5):
        check_frame(frame, BODY.template, tmp_path)
    assert (time.process_time() - start) / 5 < 0.05  # 12 ms on an idle core


def test_a_doubt_is_logged_once_an_outfit(tmp_path, caplog, monkeypatch):
    dress = find_outfit("nowhere", "sample", "dress", SCANNERS["perfect"])
    monkeypatch.setattr("avatar.data.outfits.check_frame", lambda *args: {"fit": "it lies 0.04 m from it."})
    for name in dress.frames("test")[:3]:
        dress.load("test", name)
    assert [record.message.count("it lies 0.04 m") for record in caplog.records] == [1]


def test_a_gown_over_the_feet_is_doubtful_and_passes(tmp_path):
    doubts = check_frame(person(named_pose({}), ease=0.02, flare=0.25), BODY.template, tmp_path)
    assert "apart" in doubts and re.search(r"lie \d\.\d cm from it .*missing or covered", doubts["apart"])
