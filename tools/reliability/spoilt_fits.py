"""Faults of fits: functions of the arrays of a packed frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from reliability.spoilt import READ, REFUSED, WARNED, put, swapped, turn
from reliability.spoilt_scans import changed, lacking, of_frame, whole

REST = np.zeros((33, 3), np.float32)  # of hands and face


def sides(pose: np.ndarray) -> np.ndarray:
    """A pose whose left and right joints are exchanged."""
    return pose[swapped()]


FITS = [
    ("pose alone", READ, "", lacking("body_verts", "vtransf")),
    ("vertices and transforms alone", READ, "", lacking("pose", "translation")),
    (
        "nothing to place the body",
        REFUSED,
        "expected vtransf, joint_transforms or pose",
        lacking("pose", "vtransf"),
    ),
    ("pose in degrees", REFUSED, r"degrees: multiply by pi / 180", changed(pose=np.degrees)),
    (
        "pose as matrices",
        REFUSED,
        "These are rotation matrices",
        changed(pose=lambda p: Rotation.from_rotvec(p).as_matrix()),
    ),
    (
        "pose as quaternions",
        REFUSED,
        "These are quaternions",
        changed(pose=lambda p: Rotation.from_rotvec(p).as_quat()),
    ),
    ("pose flat", REFUSED, r"It is flat: pose\.reshape\(22, 3\)", changed(pose=np.ravel)),
    ("pose of SMPL-X's 55 joints, hands at rest", READ, "", changed(pose=lambda p: np.concatenate([p, REST]))),
    (
        "pose of 55 joints, fingers bent",
        REFUSED,
        "all_joints: true",
        changed(pose=lambda p: np.concatenate([p, REST + 0.2])),
    ),
    ("pose of 21 joints", REFUSED, r"expected shape \(22, 3\).* got \(21, 3\)", changed(pose=lambda p: p[:21])),
    (
        "pose negated",
        REFUSED,
        "pose: expected it to put the template.*If negated it does",
        changed(pose=lambda p: -p),
    ),
    ("pose of zeros", REFUSED, "pose: expected it to put the template.*zeros", changed(pose=np.zeros_like)),
    (
        "pose with left and right exchanged",
        REFUSED,
        "pose: expected it to put the template.*If left and right are exchanged it does",
        changed(pose=sides),
    ),
    (
        "pose without the root's rotation",
        REFUSED,
        "is the root's rotation in both",
        lambda f, base: f | {"pose": np.concatenate([np.float32([[0, 1.5, 0]]), f["pose"][1:]])},
    ),
    (
        "pose of another frame",
        REFUSED,
        "pose: expected it to put the template.*this frame's",
        of_frame("train/walk.00002.npz", "pose"),
    ),
    ("pose with a NaN", REFUSED, "pose: expected finite numbers", put("pose", 3, np.nan)),
    (
        "translation in millimetres",
        REFUSED,
        "is the translation right|translation in metres|millimetres",
        changed(translation=lambda t: 1000 * (t + 1)),
    ),
    (
        "translation in centimetres",
        REFUSED,
        "is the translation right|translation in metres|centimetres",
        changed(translation=lambda t: 100 * (t + 0.1)),
    ),
    (
        "translation of another frame",
        REFUSED,
        "is the translation right",
        changed(translation=lambda t: t + np.float32([0.2, 0, 0.3])),
    ),
    ("no translation", READ, "", lacking("translation")),
    (
        "translation alone wrong, body derived",
        REFUSED,
        r"expected it over its body.*Moving it by|lies \(",
        lambda f, base: changed(translation=lambda t: t + 0.3)(lacking("body_verts", "vtransf")(f, base), base),
    ),
    ("body in centimetres", REFUSED, "body: expected about .*centimetres", changed(body_verts=lambda v: 100 * v)),
    ("body in millimetres", REFUSED, "body: expected about .*millimetres", changed(body_verts=lambda v: 1000 * v)),
    (
        "body and scan in centimetres",
        REFUSED,
        "body: expected about .*centimetres",
        changed(body_verts=lambda v: 100 * v, scan_pc=lambda p: 100 * p),
    ),
    (
        "body of another frame",
        REFUSED,
        "expected it to put the template on the frame's body",
        of_frame("train/walk.00002.npz", "body_verts"),
    ),
    (
        "body, transforms of another frame",
        REFUSED,
        "is the fit of another frame or person",
        lambda f, base: of_frame("train/walk.00002.npz", "body_verts", "vtransf")(
            lacking("pose", "translation")(f, base), base
        ),
    ),
    (
        "body moved by 5 cm",
        REFUSED,
        r"lies \(-0\.05, .*m from it|Moving it by \(0\.05, ",
        lambda f, base: lacking("pose", "translation")(
            changed(body_verts=lambda v: v + np.float32([0.05, 0, 0]))(f, base), base
        ),
    ),
    (
        "body with another order of vertices",
        REFUSED,
        r"body: .*edges are \d+\.\d+ times",
        changed(body_verts=lambda v: v[::-1]),
    ),
    (
        "body of another count of vertices",
        REFUSED,
        r"expected shape \(V, 4, 4\) with V=\d+, got",
        changed(body_verts=lambda v: v[:-5]),
    ),
    ("body with a NaN", REFUSED, "body_verts: expected finite numbers", put("body_verts", 3, np.nan)),
    (
        "body of a person 1.1 times as tall",
        REFUSED,
        r"body: .*edges are 1\.10 times",
        lambda f, base: lacking("pose", "translation")(
            changed(body_verts=lambda v: 1.1 * v, scan_pc=lambda p: 1.1 * p)(f, base), base
        ),
    ),
    (
        "transforms transposed",
        REFUSED,
        "vtransf: .*Transposed it does",
        lambda f, base: (
            lacking("pose")(
                changed(vtransf=lambda t: np.concatenate([np.swapaxes(t[:, :3, :3], 1, 2), t[:, :3, 3:]], 2))(f, base),
                base,
            )
            | {"vtransf": np.swapaxes(f["vtransf"][:, :3, :3], 1, 2)}
        ),
    ),
    (
        "transforms that are the identity",
        REFUSED,
        "vtransf: .*It is the identity",
        changed(vtransf=lambda t: np.tile(np.eye(4, dtype=np.float32), (len(t), 1, 1))),
    ),
    (
        "transforms of another frame",
        REFUSED,
        "vtransf: expected it to turn",
        of_frame("train/walk.00002.npz", "vtransf"),
    ),
    (
        "transforms of another count",
        REFUSED,
        r"vtransf: expected shape \(V, 4, 4\) with V=\d+, got",
        changed(vtransf=lambda t: t[:-1]),
    ),
    (
        "transforms with row vectors' translations",
        REFUSED,
        "vtransf: ",
        changed(vtransf=lambda t: np.swapaxes(t, 1, 2)),
    ),
    (
        "joint transforms of another frame",
        REFUSED,
        "joint_transforms: expected it to put",
        lambda f, base: f | {"joint_transforms": np.tile(np.eye(4, dtype=np.float32), (22, 1, 1))},
    ),
    (
        "joint transforms of 24 joints",
        REFUSED,
        "joint_transforms: expected 22 rows",
        lambda f, base: f | {"joint_transforms": np.tile(np.eye(4, dtype=np.float32), (24, 1, 1))},
    ),
    ("scan and body mirrored", REFUSED, "With the template mirrored it does", whole(np.diag([-1.0, 1, 1]))),
    (
        "scan, body and transforms mirrored",
        REFUSED,
        r"determinants are -1\.00: they mirror",
        lambda f, base: (
            whole(np.diag([-1.0, 1, 1]))(f, base) | {"vtransf": np.diag([-1.0, 1, 1]) @ f["vtransf"][:, :3, :3]}
        ),
    ),
    (
        "body of a person 1.06 times as tall",
        WARNED,
        r"body: .*edges are 1\.06 times",
        lambda f, base: lacking("pose", "translation")(
            changed(body_verts=lambda v: 1.06 * v, scan_pc=lambda p: 1.06 * p)(f, base), base
        ),
    ),
    ("scan, body and transforms lying (z-up)", READ, "", whole(turn("x", 90))),
]
