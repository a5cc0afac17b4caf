"""BVH files as programs write them: their names, blanks, headers, channels, units and axes; maps for other rigs."""

import logging
import re

import numpy as np
import pytest
from motion_files import MIXAMO, Z_FROM_Y, assert_same_poses, travelling_walk, write_bvh
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS
from avatar.checks import DataError
from avatar.io.bvh import read_bvh
from avatar.io.joint_names import NEEDED, map_joints
from avatar.io.motions import read_motion
from avatar.records import Motion

SIDES = {"left": ("Left", "L", "l"), "right": ("Right", "R", "r")}
LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")


def rig(trunk, limbs, pattern):
    """Names of the 22 joints: those of pelvis, three spine joints, neck and head, and of `LIMBS` by a pattern."""
    names = dict(zip(("pelvis", "spine1", "spine2", "spine3", "neck", "head"), trunk.split(",")))
    for side, (long, capital, small) in SIDES.items():
        for joint, part in zip(LIMBS, limbs.split(",")):
            names[f"{side}_{joint}"] = pattern.format(part=part, side=long, s=capital, low=small)
    return names


RIGS = {
    "Mixamo": rig(
        "mixamorig:Hips,mixamorig:Spine,mixamorig:Spine1,mixamorig:Spine2,mixamorig:Neck,mixamorig:Head",
        "UpLeg,Leg,Foot,ToeBase,Shoulder,Arm,ForeArm,Hand",
        "mixamorig:{side}{part}",
    ),
    "Mixamo without colon": rig(
        "mixamorigHips,mixamorigSpine,mixamorigSpine1,mixamorigSpine2,mixamorigNeck,mixamorigHead",
        "UpLeg,Leg,Foot,ToeBase,Shoulder,Arm,ForeArm,Hand",
        "mixamorig{side}{part}",
    ),
    "old": rig("Hips,Chest,Chest2,Chest3,Neck,Head", "Hip,Knee,Ankle,Toe,Collar,Shoulder,Elbow,Wrist", "{side}{part}"),
    "old, thighs": rig(
        "Hips,Chest,Chest2,Chest3,Neck,Head", "UpLeg,LowLeg,Foot,Toe,Collar,UpArm,LowArm,Hand", "{side}{part}"
    ),
    "Biped": rig(
        "Bip01 Pelvis,Bip01 Spine,Bip01 Spine1,Bip01 Spine2,Bip01 Neck,Bip01 Head",
        "Thigh,Calf,Foot,Toe0,Clavicle,UpperArm,Forearm,Hand",
        "Bip01 {s} {part}",
    ),
    "Unreal": rig(
        "pelvis,spine_01,spine_02,spine_03,neck_01,head",
        "thigh,calf,foot,ball,clavicle,upperarm,lowerarm,hand",
        "{part}_{low}",
    ),
    "MakeHuman": rig(
        "root,spine05,spine03,spine01,neck01,head",
        "upperleg01,lowerleg01,foot,toe1-1,clavicle,upperarm01,lowerarm01,wrist",
        "{part}.{s}",
    ),
    "Rokoko": rig(
        "Hips,Spine1,Spine2,Spine3,Neck,Head", "Thigh,Shin,Foot,Toe,Shoulder,Arm,ForeArm,Hand", "{side}{part}"
    ),
    "CMU, ASF": rig(
        "root,lowerback,upperback,thorax,lowerneck,head",
        "femur,tibia,foot,toes,clavicle,humerus,radius,hand",
        "{low}{part}",
    ),
    "Xsens": rig(
        "Hips,Chest,Chest2,Chest3,Neck,Head",
        "UpperLeg,LowerLeg,Foot,Toe,Shoulder,UpperArm,ForeArm,Hand",
        "{side}{part}",
    ),
    "Rigify": rig(
        "hips,spine,chest,chest1,neck,head", "thigh,shin,foot,toe,shoulder,upper_arm,forearm,hand", "{part}.{s}"
    ),
    "SMPL's FBX": rig(
        "m_avg_Pelvis,m_avg_Spine1,m_avg_Spine2,m_avg_Spine3,m_avg_Neck,m_avg_Head",
        "Hip,Knee,Ankle,Foot,Collar,Shoulder,Elbow,Wrist",
        "m_avg_{s}_{part}",
    ),
    "MotionBuilder": rig(
        "Character1_Hips,Character1_Spine,Character1_Spine1,Character1_Spine2,Character1_Neck,Character1_Head",
        "UpLeg,Leg,Foot,ToeBase,Shoulder,Arm,ForeArm,Hand",
        "Character1_{side}{part}",
    ),
    "words": rig(
        "Hips,Spine,Spine 1,Spine 2,Neck,Head", "Up Leg,Leg,Foot,Toe Base,Shoulder,Arm,Fore Arm,Hand", "{side} {part}"
    ),
}


@pytest.fixture(scope="module")
def walk():
    return travelling_walk(0.7, 0.6)


def assert_same(read, walk, degrees=0.01):
    assert_same_poses(read.poses, walk.poses, degrees)
    np.testing.assert_allclose(read.translations, walk.translations, atol=1e-4)


@pytest.mark.parametrize("name", RIGS)
def test_skeletons_of_other_programs_give_the_motion_back(tmp_path, walk, name):
    assert_same(read_motion(write_bvh(tmp_path / "a.bvh", walk, names=RIGS[name], prefix="")), walk)


def test_a_shoulder_is_a_collar_only_above_an_arm():
    spine = ["Hips", "LeftHip", "LeftKnee", "LeftAnkle", "RightHip", "RightKnee", "RightAnkle", "Chest"]
    spine_parents = [-1, 0, 1, 2, 0, 4, 5, 0]
    for arms, expected in (
        (("Collar", "Shoulder", "Elbow", "Wrist"), {"collar": 0, "shoulder": 1, "elbow": 2, "wrist": 3}),
        (("Shoulder", "Arm", "ForeArm", "Hand"), {"collar": 0, "shoulder": 1, "elbow": 2, "wrist": 3}),
        (("Shoulder", "Elbow", "Wrist"), {"shoulder": 0, "elbow": 1, "wrist": 2}),
    ):
        names, parents = list(spine), list(spine_parents)
        for side in ("Left", "Right"):
            parents += [7, *range(len(names), len(names) + len(arms) - 1)]
            names += [side + arm for arm in arms]
        found = map_joints(names, parents)
        for joint, place in expected.items():
            assert names[found[SMPL_JOINTS.index(f"left_{joint}")]] == f"Left{arms[place]}"
        assert (SMPL_JOINTS.index("left_collar") in found) == ("collar" in expected)


def edited(text, change):
    """A file's text as another program would have written it."""
    head, _, rows = text.partition("MOTION")
    return {
        "byte order mark": "\ufeff" + text,
        "CRLF and tabs": text.replace("  ", "\t").replace("\n", "\r\n"),
        "no blanks": text.replace("Frames: ", "Frames:").replace("Frame Time: ", "Frame Time:"),
        "blank before colon": text.replace("Frames:", "Frames :\t"),
        "short frame time": re.sub(r"Frame Time: \S+", "Frame Time: 0.0333", text),
        "braces on the line": re.sub(r"\n\s*\{", " {", text),
        "comments": "# made by hand\n\n" + head.replace("OFFSET", "// bone\n  OFFSET", 1) + "MOTION\n\n# rows" + rows,
        "end sites with names": text.replace("End Site", "End Site head_end 1"),
        "small letters": re.sub("ROOT|JOINT|OFFSET|CHANNELS|HIERARCHY", lambda word: word[0].title(), text),
        "one line": " ".join(text.split()),
    }[change]


@pytest.mark.parametrize(
    "change",
    ["byte order mark", "CRLF and tabs", "no blanks", "blank before colon", "short frame time", "braces on the line",
     "comments", "end sites with names", "small letters", "one line"],
)  # fmt: skip
def test_files_as_programs_write_them(tmp_path, walk, change):
    path = write_bvh(tmp_path / "a.bvh", walk)
    path.write_bytes(edited(path.read_text(), change).encode())
    read = read_motion(path)
    assert_same(read, walk)
    assert read.fps == 30


@pytest.mark.parametrize(
    ("written", "fps"),
    [("0.0333", 30), ("0.033333", 30), ("0.008333", 120), ("0.0083333", 120), ("0.01", 100), ("0.0416667", 24),
     ("0.0333667", 29.97), ("4.1667e-3", 240), ("0.04", 25), ("0.03", 33.333)],
)  # fmt: skip
def test_frame_times_are_rounded_as_they_were_written(tmp_path, walk, written, fps):
    path = write_bvh(tmp_path / "a.bvh", walk)
    path.write_text(re.sub(r"Frame Time: \S+", f"Frame Time: {written}", path.read_text()))
    assert read_motion(path).fps == pytest.approx(fps, abs=2e-3)


def test_more_rows_are_left_out_with_a_warning_and_fewer_refused(tmp_path, walk, caplog):
    path = write_bvh(tmp_path / "a.bvh", walk)
    text, count = path.read_text(), len(walk.poses)
    path.write_text(text.replace(f"Frames: {count}", "Frames: 5"))
    assert_same(read_motion(path), Motion(walk.poses[:5], walk.translations[:5], 30.0, "a"))
    assert f"the 5 frames that its header declares of the {count} rows there" in caplog.text
    path.write_text(text.replace(f"Frames: {count}", "Frames: 99"))
    with pytest.raises(DataError, match=rf"a\.bvh: .*99 frames of 69 channels were expected.*{count} rows of 69"):
        read_motion(path)


def test_rows_of_other_lengths_are_not_taken_for_more_rows(tmp_path, walk):
    path = write_bvh(tmp_path / "a.bvh", walk)
    head, _, motion = path.read_text().partition("MOTION")
    lines = motion.splitlines()
    path.write_text("\n".join([head + "MOTION", *lines[1:3], *(f"{line} {line}" for line in lines[3:])]))
    with pytest.raises(DataError, match="rows of 69 numbers were expected, there are some of 138"):
        read_motion(path)


def six_channels(text, place):
    """Positions at every joint, ``place(offset, frame, joint)`` of them; the root has its own already."""
    head, _, motion = text.partition("MOTION")
    offsets = [np.array(found.split(), float) for found in re.findall(r"OFFSET (.+)\n\s*CHANNELS", head)]
    head = head.replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ")
    lines = motion.splitlines()
    rows = []
    for frame, line in enumerate(lines[3:]):
        numbers = line.split()
        row = numbers[:6]
        for joint in range(1, 22):
            row += [f"{value:.6f}" for value in place(offsets[joint], frame, joint)]
            row += numbers[3 + 3 * joint : 6 + 3 * joint]
        rows.append(" ".join(row))
    return head + "\n".join(["MOTION", *lines[1:3], *rows]) + "\n"


def test_positions_of_every_joint(tmp_path, walk, caplog):
    """The offsets again, zeros, or instead of offsets; where bones move their rotations are used and this is said."""
    path = write_bvh(tmp_path / "a.bvh", walk)
    text = path.read_text()
    for place in (lambda offset, *_: offset, lambda *_: np.zeros(3)):
        path.write_text(six_channels(text, place))
        assert_same(read_motion(path), walk)
    joined = six_channels(text, lambda offset, *_: offset)
    path.write_text(re.sub(r"OFFSET .*(\n\s*CHANNELS 6)", r"OFFSET 0 0 0\1", joined))
    assert_same(read_motion(path), walk)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    path.write_text(six_channels(text, lambda offset, frame, joint: offset + (joint == 3) * np.array([0, frame, 0])))
    assert_same(read_motion(path), walk)
    assert "positions of 1 joints below the root move (mixamorig:LeftFoot by 20 units)" in caplog.text


def test_hips_below_a_reference_keep_their_positions(tmp_path, walk):
    path = write_bvh(tmp_path / "a.bvh", walk)
    head, _, motion = path.read_text().partition("MOTION")
    lines = motion.splitlines()
    head = head.replace("ROOT", "ROOT reference\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\nJOINT", 1)
    rows = [f"0 0 0 {line}" for line in lines[3:]]
    path.write_text("\n".join([head + "}", "MOTION", *lines[1:3], *rows]))
    assert_same(read_motion(path), walk)


@pytest.mark.parametrize(("scale", "unit"), [(100, "cm"), (1, "m"), (1000, "mm"), (39.37, "in")])
def test_the_unit_is_named(tmp_path, walk, scale, unit, caplog):
    with caplog.at_level(logging.INFO):
        assert_same(read_motion(write_bvh(tmp_path / "a.bvh", walk, scale=scale)), walk)
    assert f"which is likely in {unit}." in caplog.text


@pytest.mark.parametrize(("basis", "up"), [(Z_FROM_Y, "z"), (np.diag([1.0, -1, -1]), "-y"), (Z_FROM_Y.T, "-z")])
def test_other_up_axes_are_noticed_and_read_as_named_or_found(tmp_path, walk, basis, up):
    path = write_bvh(tmp_path / "a.bvh", walk, basis=basis)
    with pytest.raises(DataError, match=rf"upright along y, they are upright along {up} .*Give up={up}, or up=y"):
        read_motion(path)
    assert_same(read_motion(path, up=up), walk)
    assert_same(read_motion(path, up="auto"), walk)


def test_a_map_names_the_joints_of_any_rig(tmp_path, walk):
    strange = {joint: f"Bone {number} ü" for number, joint in enumerate(SMPL_JOINTS)}
    path = write_bvh(tmp_path / "a.bvh", walk, names=strange, prefix="")
    with pytest.raises(DataError, match=r"a\.bvh: joints: .*found none for left_hip, left_knee.*Give joints=map"):
        read_motion(path)
    names = tmp_path / "map.yaml"
    names.write_text("\n".join(f"{ours}: {theirs}" for ours, theirs in strange.items()), encoding="utf-8")
    assert_same(read_motion(path, joints=names), walk)
    names.write_text("\n".join(f"{ours}: {strange[ours]}" for ours in NEEDED if ours != "left_elbow"), encoding="utf-8")
    with pytest.raises(DataError, match=r"a\.bvh: joints: .*found none for left_elbow among Bone 0"):
        read_motion(path, joints=names)
    for line, problem in (
        ("left_albow: Bone 18 ü", r"map\.yaml: joints: expected one of .*Did you mean 'left_elbow'"),
        ("left_elbow: Bone 99", r"a\.bvh: joints: expected names in the skeleton, got left_elbow: Bone 99"),
        ("left_elbow: [1, 2]", r"map\.yaml: left_elbow: expected the name of a joint, got \[1, 2\]"),
    ):
        names.write_text(line, encoding="utf-8")
        with pytest.raises(DataError, match=problem):
            read_motion(path, joints=names)
    names.write_text("\n".join(f"{ours}: {strange[ours]}" for ours in NEEDED).replace("Bone 18", "Bone 4"))
    with pytest.raises(
        DataError, match=r"expected left_elbow below left_shoulder, got others: left_elbow is 'Bone 4 ü'"
    ):
        read_motion(path, joints=names)


def test_a_map_completes_names_that_are_known(tmp_path, walk):
    path = write_bvh(tmp_path / "a.bvh", walk, names={**MIXAMO, "left_elbow": "Tentacle"}, prefix="")
    (tmp_path / "map.yaml").write_text("left_elbow: Tentacle\n")
    assert_same(read_motion(path, joints=tmp_path / "map.yaml"), walk)


def test_every_joint_may_have_an_order_of_its_own(tmp_path, walk):
    """As many letters as there are: each joint's three channels in another order, their numbers with them."""
    path, rng = write_bvh(tmp_path / "a.bvh", walk, order="ZXY"), np.random.default_rng(0)
    head, _, motion = path.read_text().partition("MOTION")
    lines = motion.splitlines()
    rows = np.array([line.split() for line in lines[3:]], float)
    parts = re.split("Zrotation Xrotation Yrotation", head)
    text = parts[0]
    for joint, part in enumerate(parts[1:]):
        order = "".join(rng.permutation(list("XYZ")))
        columns = slice(3 + 3 * joint, 6 + 3 * joint)
        turns = Rotation.from_euler("ZXY", rows[:, columns], degrees=True)
        rows[:, columns] = turns.as_euler(order, degrees=True)
        text += " ".join(f"{axis}rotation" for axis in order) + part
    path.write_text("\n".join([f"{text}MOTION", *lines[1:3], *(" ".join(map(str, row)) for row in rows)]))
    assert_same(read_motion(path), walk)
    assert len(read_bvh(path).names) == 22


def test_swapped_sides_are_noticed_by_the_toes(tmp_path, walk, caplog):
    swap = {"left": "Right", "right": "Left"}
    names = {j: MIXAMO[j].replace("Left", "").replace("Right", "") for j in SMPL_JOINTS}
    names = {j: swap.get(j.split("_")[0], "") + name for j, name in names.items()}
    read_motion(write_bvh(tmp_path / "a.bvh", walk, names=names))
    assert re.search(r"toes point backwards \(left: 0\.\d\d of 1\): left and right may be swapped", caplog.text)
    caplog.clear()
    read_motion(write_bvh(tmp_path / "a.bvh", walk))
    assert not caplog.records


def test_damaged_files_are_one_error_or_read(tmp_path, walk):
    """Bytes changed, cut out and doubled at random: nothing but a `DataError` ever comes of it."""
    text = write_bvh(tmp_path / "a.bvh", Motion(walk.poses[:2], walk.translations[:2], 30.0, "a")).read_text()
    rng, path, refused = np.random.default_rng(1), tmp_path / "b.bvh", 0
    for _ in range(300):
        start, length = rng.integers(len(text)), int(rng.integers(1, 60))
        piece = text[start : start + length]
        other = rng.choice(["", piece * 2, "}", "{", "JOINT x", "CHANNELS 3 ", "-", "1e999", "#", "\n", "Frames: 7"])
        path.write_text(text[:start] + str(other) + text[start + length :])
        try:
            read_motion(path)
        except DataError:
            refused += 1
    assert refused > 150
