"""People's own data with one fault each: what is spoilt, what must come of it, and the cause that must be named."""

from __future__ import annotations

import json
import logging
import re
import shutil
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.checks import AvatarError
from avatar.data.folders import SPLITS
from avatar.data.layouts import find_outfit, open_outfit_folder
from avatar.data.scanner import ScanConfig, scan_mesh
from avatar.data.splits import split_outfit
from avatar.geometry.surface import vertex_normals
from avatar.io.motions import read_motion
from avatar.io.stance import joint_places
from avatar.io.surfaces import read_surface
from avatar.simulate.angles import authored_motion
from reliability.findings import Finding, all_of, none_of

READ, WARNED, REFUSED = "read", "warned", "refused"
CELL = 0.02  # metres: vertices of the body in one cell become one, so that the trial is fast
POINTS = 6_000  # of a scan
FRAME = "train/walk.00000.npz"  # the frame that is spoilt
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Spoilt:
    """One way to spoil data: ``part`` of it, in ``words``, the ``wanted`` outcome and a pattern of its ``cause``."""

    part: str
    words: str
    wanted: str
    cause: str
    spoil: Callable


@dataclass(frozen=True)
class Result:
    """What came of one: the ``outcome`` and its ``message``, and an error's type where it is none of ours."""

    spoilt: Spoilt
    outcome: str
    message: str
    untyped: str = ""

    @property
    def met(self) -> bool:
        """Whether the outcome is the wanted one, with its cause."""
        right = self.outcome == self.spoilt.wanted and not self.untyped
        return right and re.search(self.spoilt.cause, self.message, re.DOTALL) is not None


class Base:
    """A valid outfit of three training and two test frames in memory: ``body``, ``frames`` by path, a ``motion``."""

    def __init__(self, folder: Path):
        sample = find_outfit(Path(), "sample", "tee", ScanConfig(points=POINTS))
        self.body, names = coarse_body(sample.body), {}
        names |= {f"train/walk.{i:05d}.npz": ("train", name) for i, name in enumerate(sample.frames("train")[1:4])}
        names |= {f"test/walk.{i:05d}.npz": ("test", name) for i, name in enumerate(sample.frames("test")[:2], 3)}
        save(folder / "template.npz", self.body)
        own = open_outfit_folder(folder)
        self.frames: dict[str, Arrays] = {}
        for path, place in names.items():
            frame = sample.load(*place)
            fit = own.fit_pose(frame.body.pose, frame.body.translation)
            arrays = {"scan_pc": frame.scan.points, "scan_n": frame.scan.normals, "pose": fit.pose}
            arrays |= {"translation": fit.translation, "body_verts": fit.vertices, "vtransf": fit.vertex_transforms}
            self.frames[path] = arrays
            if path == FRAME:
                self.joints = fit.joint_transforms
                mesh = scan_mesh(sample.load_surface(*place))
                self.mesh = {"scan_pc": mesh.points, "scan_n": mesh.normals, "scan_faces": mesh.faces}
        motion = authored_motion("walk", fps=30, seconds=2.0)
        places = joint_places(motion.poses, self.body["joints"])
        feet = places[:, [SMPL_JOINTS.index(f"{side}_foot") for side in ("left", "right")]]
        lowest = (feet[1:, :, 1] + feet[:-1, :, 1]).argmin(axis=1)
        steps = -np.diff(feet, axis=0)[np.arange(len(lowest)), lowest]  # the foot that stands stays where it is
        travel = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        poses = np.zeros((len(motion.poses), 52, 3))
        poses[:, : len(SMPL_JOINTS)] = motion.poses
        turn = Rotation.from_euler("x", 90, degrees=True)  # AMASS has z up
        poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        self.motion = {"poses": poses.reshape(len(poses), -1), "trans": turn.apply(travel)}
        self.motion["mocap_framerate"] = np.array(30.0)

    def copy(self, arrays: Arrays) -> Arrays:
        """The arrays, to be changed."""
        return {key: np.array(value) for key, value in arrays.items()}


def coarse_body(body: BodyModel) -> Arrays:
    """The arrays of a ``template.npz`` in the T-pose: a body with fewer vertices."""
    template = body.with_canonical_pose(torch.zeros_like(body.canonical_pose)).template
    vertices, faces = template.vertices.numpy(), template.faces.numpy()
    _, owners, ids = np.unique(np.floor(vertices / CELL), axis=0, return_index=True, return_inverse=True)
    corners = ids.reshape(-1)[faces]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    arrays = {"vertices": vertices[owners], "faces": corners.astype(np.int32)}
    arrays |= {"weights": template.weights.numpy()[owners], "joints": template.joints.numpy()}
    return arrays | {"parents": np.array(template.parents), "joint_names": np.array(template.joint_names)}


def save(path: Path, arrays: Arrays) -> None:
    """Writes an npz as numpy does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)


# --- scans and fits: functions of a frame's arrays -------------------------------------------------------------------


def turn(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def moved(linear: np.ndarray, shift: tuple[float, float, float] = (0, 0, 0), about: bool = False) -> Callable:
    """The scan turned, mirrored, scaled and moved; about the middle of its body where asked."""

    def spoil(frame: Arrays, base: Base) -> Arrays:
        middle = frame["body_verts"].mean(axis=0) if about else np.zeros(3)
        points = (frame["scan_pc"] - middle) @ np.transpose(linear) + middle + shift
        normals = frame["scan_n"] @ np.transpose(linear) / np.cbrt(abs(np.linalg.det(linear)))
        return frame | {"scan_pc": points.astype(np.float32), "scan_n": normals.astype(np.float32)}

    return spoil


def changed(**changes: Callable) -> Callable:
    """Some of a frame's arrays, each changed by a function of its own."""
    return lambda frame, base: frame | {key: change(frame[key]) for key, change in changes.items()}


def lacking(*keys: str) -> Callable:
    return lambda frame, base: {key: value for key, value in frame.items() if key not in keys}


def kept(which: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable:
    """The scan without some of its points, by the points and the body's joints."""

    def spoil(frame: Arrays, base: Base) -> Arrays:
        stay = which(frame["scan_pc"], base)
        return frame | {key: frame[key][stay] for key in ("scan_pc", "scan_n")}

    return spoil


def added(make: Callable[[np.ndarray, np.random.Generator], tuple[np.ndarray, np.ndarray]]) -> Callable:
    """The scan with other points beside it, as a function of its own gives them."""

    def spoil(frame: Arrays, base: Base) -> Arrays:
        points, normals = make(frame["scan_pc"], np.random.default_rng(0))
        return frame | {
            "scan_pc": np.concatenate([frame["scan_pc"], points]).astype(np.float32),
            "scan_n": np.concatenate([frame["scan_n"], normals]).astype(np.float32),
        }

    return spoil


def plane(width: float, level: str, normal: tuple[float, float, float] = (0, 1, 0)) -> Callable:
    """A square of points at the feet (``floor``) or behind the back (``wall``)."""

    def make(scan: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        flat = rng.uniform(-width / 2, width / 2, (3000, 3))
        middle = scan.mean(axis=0)
        axis = 1 if level == "floor" else 2
        flat[:, axis] = rng.normal(scale=0.002, size=3000)
        middle[axis] = scan[:, axis].min() - (0 if level == "floor" else 0.3)
        return flat + middle, np.tile(np.eye(3)[axis], (3000, 1))

    return make


def beside(distance: float) -> Callable:
    """The same person once more, so far to the side."""
    return lambda frame, base: added(lambda scan, rng: (scan + [distance, 0, 0.1], frame["scan_n"]))(frame, base)


def strays(count: int, near: float, far: float) -> Callable:
    """Single points between two distances from the middle of the scan's surface."""

    def make(scan: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        tree, found = cKDTree(scan), []
        while len(found) < count:
            point = scan[rng.integers(len(scan))] + rng.normal(size=3) * far
            if near < tree.query(point)[0] < far:
                found.append(point)
        return np.array(found), np.tile([0.0, 1.0, 0.0], (count, 1))

    return make


def box(scan: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A chair beside the person: a box of 40 cm."""
    side = rng.integers(3, size=1500)
    points = rng.uniform(-0.2, 0.2, (1500, 3))
    signs = rng.choice([-1.0, 1.0], 1500)
    points[np.arange(1500), side] = 0.2 * signs
    place = [scan[:, 0].max() + 0.45, scan[:, 1].min() + 0.2, scan[:, 2].mean()]
    return points + place, np.eye(3)[side] * signs[:, None]


def of_frame(path: str, *keys: str) -> Callable:
    """Some arrays of another frame."""
    return lambda frame, base: frame | {key: base.frames[path][key] for key in keys}


def flipped(share: float) -> Callable:
    """So many of the normals turned round."""
    rng = np.random.default_rng(0)
    return changed(scan_n=lambda normals: np.where(rng.random((len(normals), 1)) < share, -normals, normals))


def with_mesh(change: Callable[[Arrays], Arrays]) -> Callable:
    """The frame with a scan that is a mesh, changed."""
    return lambda frame, base: change(frame | base.copy(base.mesh))


def put(key: str, index: int, value: object) -> Callable:
    """One row of an array set to a value."""

    def spoil(frame: Arrays, base: Base) -> Arrays:
        frame[key][index] = value
        return frame

    return spoil


def whole(linear: np.ndarray) -> Callable:
    """Scan, body and transforms, all turned, mirrored or scaled alike."""

    def spoil(frame: Arrays, base: Base) -> Arrays:
        linear_ = np.asarray(linear, np.float64)
        scale = np.cbrt(abs(np.linalg.det(linear_)))
        frame = {key: value for key, value in frame.items() if key not in ("pose", "translation")}
        for key in ("scan_pc", "body_verts"):
            frame[key] = (frame[key] @ linear_.T).astype(np.float32)
        frame["scan_n"] = (frame["scan_n"] @ linear_.T / scale).astype(np.float32)
        inner = linear_ @ frame["vtransf"][:, :3, :3] @ (np.eye(3) if np.linalg.det(linear_) > 0 else linear_)
        frame["vtransf"] = inner.astype(np.float32) / scale
        return frame

    return spoil


def away(frame: Arrays, distance: float, kind: type) -> Arrays:
    """Scan and body far from the origin, of a type."""
    arrays = {key: (frame[key].astype(np.float64) + distance).astype(kind) for key in ("scan_pc", "body_verts")}
    return {key: value for key, value in (frame | arrays).items() if key not in ("pose", "translation")}


def sides(pose: np.ndarray) -> np.ndarray:
    """A pose whose left and right joints are exchanged."""
    names = [n.replace("left", "*").replace("right", "left").replace("*", "right") for n in SMPL_JOINTS]
    return pose[[SMPL_JOINTS.index(name) for name in names]]


def head(points: np.ndarray, base: Base) -> np.ndarray:
    place = base.joints[SMPL_JOINTS.index("head")] @ np.append(base.body["joints"][SMPL_JOINTS.index("head")], 1)
    return np.linalg.norm(points - place[:3] - [0, 0.05, 0], axis=1) > 0.22


def bone(name: str, radius: float) -> Callable:
    """Which points are farther than a radius from a joint."""

    def which(points: np.ndarray, base: Base) -> np.ndarray:
        index = SMPL_JOINTS.index(name)
        place = base.joints[index] @ np.append(base.body["joints"][index], 1)
        return np.linalg.norm(points - place[:3], axis=1) > radius

    return which


REST = np.zeros((33, 3), np.float32)  # of hands and face
FAR_PLACE = np.array([0.0, 900.0, 2500.0], np.float32)
ON = ("scan_pc", "scan_n")
FRAMES = {
    "scan": [
        ("as it is", READ, "", lambda frame, base: frame),
        ("in centimetres", REFUSED, "scan: expected about .*centimetres: divide", moved(100 * np.eye(3))),
        ("in millimetres", REFUSED, "millimetres: divide .* by 1000", moved(1000 * np.eye(3))),
        ("in inches", REFUSED, r"inches: divide .* by 39\.37", moved(np.eye(3) / 0.0254)),
        ("in kilometres", REFUSED, "multiply positions and translations by 1000", moved(np.eye(3) / 1000)),
        ("0.7 times as large", REFUSED, r"0\.70 times the body's size.*Divide its positions by 0\.70", moved(0.7 * np.eye(3))),
        ("0.9 times as large", REFUSED, r"0\.90 times the body's size.*Divide its positions by 0\.90", moved(0.9 * np.eye(3))),
        ("0.95 times as large", WARNED, r"0\.95 times the body's size", moved(0.95 * np.eye(3))),
        ("1.05 times as large", WARNED, r"1\.05 times the body's size", moved(1.05 * np.eye(3))),
        ("1.1 times as large", REFUSED, r"1\.10 times the body's size", moved(1.1 * np.eye(3))),
        ("1.3 times as large", REFUSED, r"ividing its positions by 1\.(29|3)", moved(1.3 * np.eye(3))),
        ("1.6 times as large", REFUSED, r"ividing its positions by 1\.(59|6)", moved(1.6 * np.eye(3))),
        ("moved by 3.5 cm to the side", WARNED, r"lies \(0\.03, .*m from it|lies \(0\.04, .*m from it", moved(np.eye(3), (0.035, 0, 0))),
        ("moved by 5 cm to the side", REFUSED, r"Moving it by \(-0\.05, ", moved(np.eye(3), (0.05, 0, 0))),
        ("moved by 5 cm up", REFUSED, r"Moving it by \(-?0\.00, -0\.05, ", moved(np.eye(3), (0, 0.05, 0))),
        ("moved by 10 cm", REFUSED, r"lies \(0\.10, .*m from it", moved(np.eye(3), (0.1, 0, 0))),
        ("moved by 50 cm", REFUSED, r"Moving it by \(-0\.(49|5)", moved(np.eye(3), (0.5, 0, 0))),
        ("in another room", REFUSED, r"Moving it by \(-3\.\d\d, .*, -2\.\d\d\)", moved(np.eye(3), (3, 0, 2))),
        ("moved by a translation in millimetres", REFUSED, "is the translation in metres", moved(np.eye(3), FAR_PLACE)),
        *((f"turned by 5 degrees about {axis}", WARNED, r"turned by 5 degrees about", moved(turn(axis, 5), about=True)) for axis in "xyz"),
        *((f"turned by 20 degrees about {axis}", REFUSED, r"turned by (19|20) degrees about|another frame", moved(turn(axis, 20), about=True)) for axis in "xyz"),
        *((f"turned by 90 degrees about {axis}", REFUSED, f"Turning the scan by -90 degrees about {axis}", moved(turn(axis, 90), about=True)) for axis in "xyz"),
        *((f"turned by 180 degrees about {axis}", REFUSED, f"Turning the scan by 180 degrees about {axis}", moved(turn(axis, 180), about=True)) for axis in "xyz"),
        ("turned by 180 degrees about y and moved", REFUSED, r"Turning the scan by 180 degrees about y and moving", moved(turn("y", 180), (0.5, 0, 1))),
        ("mirrored", REFUSED, r"Mirroring the scan \(x to -x\)", moved(np.diag([-1, 1, 1]))),
        ("mirrored, y and z swapped", REFUSED, r"Swapping y and z of the scan|Mirroring", moved(np.eye(3)[[0, 2, 1]])),
        ("of another frame", REFUSED, "is the fit of another frame or person", of_frame("train/walk.00002.npz", *ON)),
        ("of a taller person", REFUSED, r"1\.10 times .*another person's shape", moved(1.1 * np.eye(3), about=True)),
        ("without what is below the waist", REFUSED, "part of the person missing", kept(lambda p, base: p[:, 1] > np.median(p[:, 1]))),
        ("without its left half", REFUSED, "part of the person missing", kept(lambda p, base: p[:, 0] < np.median(p[:, 0]))),
        ("without the head", WARNED, r"head, hands and feet lie .* cm.*missing or covered", kept(head)),
        ("without a hand", WARNED, r"head, hands and feet lie .* cm.*missing or covered", kept(bone("left_wrist", 0.2))),
        ("with holes of 8 cm", READ, "", kept(lambda p, base: cKDTree(p[:: len(p) // 6]).query(p)[0] > 0.04)),
        ("of 50 points", REFUSED, "at least 100 points, got 50", kept(lambda p, base: np.arange(len(p)) < 50)),
        ("of no points", REFUSED, "at least 100 points, got 0", kept(lambda p, base: np.zeros(len(p), bool))),
        ("with all points at one place", REFUSED, "scan: expected about", changed(scan_pc=lambda p: np.tile(p[:1], (len(p), 1)))),
        ("with a floor of 3 m", REFUSED, "lie apart from the body on a plane.*floor or wall", added(plane(3, "floor"))),
        ("with a floor of 1 m", REFUSED, "lie apart from the body on a plane.*floor or wall", added(plane(1, "floor"))),
        ("with a wall behind", REFUSED, "lie apart from the body on a plane.*floor or wall", added(plane(2, "wall"))),
        ("with a second person beside", REFUSED, "50.00% lie apart|another person or furniture", beside(1.2)),
        ("with a second person 5 m away", REFUSED, "another person or furniture", beside(5.0)),
        ("with a box beside", REFUSED, "another person or furniture", added(box)),
        ("with 5 stray points at 5 m", REFUSED, r"5 of 6005 points .*stray points", added(strays(5, 3, 6))),
        ("with 1 stray point at 100 m", REFUSED, r"1 of 6001 points .*stray points", added(strays(1, 80, 110))),
        ("with 10 stray points at 3 dm", REFUSED, r"10 of 6010 points .*stray points", added(strays(10, 0.27, 0.35))),
        ("with 1 stray point at 3 dm", WARNED, r"1 of 6001 points .*stray points", added(strays(1, 0.27, 0.33))),
        ("with a point at 1e30", REFUSED, r"1 of 6000 points .*e\+30 m", put("scan_pc", 7, 1e30)),
        ("with a NaN point", REFUSED, "scan_pc: expected finite numbers, got 3 NaN", put("scan_pc", 7, np.nan)),
        ("with an infinite coordinate", REFUSED, "scan_pc: expected finite numbers", put("scan_pc", (7, 1), np.inf)),
        ("with a NaN normal", REFUSED, "scan_n: expected finite numbers", put("scan_n", 7, np.nan)),
        ("with a normal of no length", REFUSED, "scan normals: expected unit length, got 0 ", put("scan_n", 7, 0)),
        ("with normals of length 2", READ, "", changed(scan_n=lambda n: 2 * n)),
        ("with normals inward", REFUSED, "multiply its normals by -1", changed(scan_n=lambda n: -n)),
        ("with normals either way", REFUSED, r"only \d\d% do\. Orient them", flipped(0.5)),
        ("with a fifth of the normals inward", WARNED, r"only (7|8)\d% do", flipped(0.2)),
        ("with normals of another order", REFUSED, r"only \d\d% do|do not fit", changed(scan_n=lambda n: np.random.default_rng(0).permutation(n))),
        ("with normals still z-up", REFUSED, r"scan normals: .*turned alike", changed(scan_n=lambda n: n @ turn("x", 90).T)),
        ("with normals all upward", REFUSED, r"scan normals", changed(scan_n=lambda n: np.tile(np.float32([0, 1, 0]), (len(n), 1)))),
        ("with every point twice", READ, "", changed(scan_pc=lambda p: np.repeat(p, 2, 0), scan_n=lambda n: np.repeat(n, 2, 0))),
        ("with noise of 2 mm", READ, "", changed(scan_pc=lambda p: p + np.random.default_rng(0).normal(scale=0.002, size=p.shape))),
        ("with noise of 3 cm", WARNED, r"scan: .*noise", changed(scan_pc=lambda p: p + np.random.default_rng(0).normal(scale=0.03, size=p.shape))),
        ("with points and normals of other counts", REFUSED, "scan_n: expected shape", changed(scan_n=lambda n: n[:-1])),
        ("as doubles", READ, "", changed(scan_pc=lambda p: p.astype(np.float64))),
        ("as half floats", READ, "", changed(scan_pc=lambda p: p.astype(np.float16))),
        ("as half floats, 5 m from the origin", REFUSED, r"scan_pc: .*float16 rounds those at \d", lambda f, base: away(f, 5, np.float16)),
        ("10 km from the origin", WARNED, r"float32 rounds those at 1e\+04 m to 0.00098 m", lambda f, base: away(f, 1e4, np.float64)),
        ("1000 km from the origin", REFUSED, r"float32 rounds those at 1e\+06 m", lambda f, base: away(f, 1e6, np.float64)),
        ("big-endian", READ, "", changed(scan_pc=lambda p: p.astype(">f4"), scan_n=lambda n: n.astype(">f8"))),
        ("in Fortran order", READ, "", changed(scan_pc=np.asfortranarray)),
        ("as whole millimetres", REFUSED, "scan_pc: expected float, got int", changed(scan_pc=lambda p: (1000 * p).astype(np.int32))),
        ("as complex numbers", REFUSED, "scan_pc: expected float, got complex", changed(scan_pc=lambda p: p.astype(np.complex64))),
        ("as one number", REFUSED, "scan_pc: expected shape", changed(scan_pc=lambda p: p[0, 0])),
        ("transposed", REFUSED, r"scan_pc: expected shape \(M, 3\), got \(3, 6000\)", changed(scan_pc=lambda p: p.T)),
        ("in homogeneous coordinates", REFUSED, r"scan_pc: expected shape \(M, 3\), got \(6000, 4\)", changed(scan_pc=lambda p: np.pad(p, ((0, 0), (0, 1))))),
        ("in a batch of one", REFUSED, r"scan_pc: expected shape", changed(scan_pc=lambda p: p[None])),
        ("as Python objects", REFUSED, "scan_pc: expected float, found Python objects", changed(scan_pc=lambda p: p.astype(object))),
        ("without normals", REFUSED, "expected the keys scan_n", lacking("scan_n")),
        ("under other keys", REFUSED, "expected the keys scan_pc, .*found only: .*points", lambda f, base: lacking("scan_pc")(f | {"points": f["scan_pc"]}, base)),
        ("a mesh", READ, "", with_mesh(lambda f: f)),
        ("a mesh of no faces", READ, "", with_mesh(lambda f: f | {"scan_faces": f["scan_faces"][:0]})),
        ("a mesh wound inward", REFUSED, r"scan faces: .*wound inward \(swap two", with_mesh(lambda f: f | {"scan_faces": f["scan_faces"][:, ::-1]})),
        ("a mesh, mirrored", REFUSED, r"Mirroring the scan \(x to -x\)", with_mesh(lambda f: moved(np.diag([-1, 1, 1]))(f, None))),
        ("a mesh with a third of its faces turned over", REFUSED, r"scan faces: .*3\d% are not", with_mesh(lambda f: f | {"scan_faces": np.where(np.arange(len(f["scan_faces"]))[:, None] % 3, f["scan_faces"], f["scan_faces"][:, ::-1])})),
        ("a mesh with a tenth of its faces turned over", WARNED, r"scan faces: .*1\d% are not", with_mesh(lambda f: f | {"scan_faces": np.where(np.arange(len(f["scan_faces"]))[:, None] % 8, f["scan_faces"], f["scan_faces"][:, ::-1])})),
        ("a mesh with faces of another", REFUSED, "scan faces: .*Are they this scan's", with_mesh(lambda f: f | {"scan_faces": np.random.default_rng(0).permutation(len(f["scan_pc"]))[f["scan_faces"]]})),
        ("a mesh with faces from 1", REFUSED, r"scan_faces: expected indices in \[0", with_mesh(lambda f: f | {"scan_faces": f["scan_faces"] + 1})),
        ("a mesh with faces of floats", REFUSED, "scan_faces: expected int, got float", with_mesh(lambda f: f | {"scan_faces": f["scan_faces"].astype(np.float32)})),
        ("a mesh of quads", REFUSED, r"scan_faces: expected shape \(F, 3\)", with_mesh(lambda f: f | {"scan_faces": np.pad(f["scan_faces"], ((0, 0), (0, 1)))})),
        ("with colours from 0 to 255 as floats", REFUSED, "colours from 0 to 1, got 200", lambda f, base: f | {"scan_colors": np.full((len(f["scan_pc"]), 3), 200.0)}),
    ],
    "fit": [
        ("pose alone", READ, "", lacking("body_verts", "vtransf")),
        ("vertices and transforms alone", READ, "", lacking("pose", "translation")),
        ("nothing to place the body", REFUSED, "expected vtransf, joint_transforms or pose", lacking("pose", "vtransf")),
        ("pose in degrees", REFUSED, r"degrees: multiply by pi / 180", changed(pose=np.degrees)),
        ("pose as matrices", REFUSED, "These are rotation matrices", changed(pose=lambda p: Rotation.from_rotvec(p).as_matrix())),
        ("pose as quaternions", REFUSED, "These are quaternions", changed(pose=lambda p: Rotation.from_rotvec(p).as_quat())),
        ("pose flat", REFUSED, r"It is flat: pose\.reshape\(22, 3\)", changed(pose=np.ravel)),
        ("pose of SMPL-X's 55 joints, hands at rest", READ, "", changed(pose=lambda p: np.concatenate([p, REST]))),
        ("pose of 55 joints, fingers bent", REFUSED, "all_joints: true", changed(pose=lambda p: np.concatenate([p, REST + 0.2]))),
        ("pose of 21 joints", REFUSED, r"expected shape \(22, 3\).* got \(21, 3\)", changed(pose=lambda p: p[:21])),
        ("pose negated", REFUSED, "pose: expected it to put the template.*Negated it does", changed(pose=lambda p: -p)),
        ("pose of zeros", REFUSED, "pose: expected it to put the template.*zeros", changed(pose=np.zeros_like)),
        ("pose with left and right exchanged", REFUSED, "pose: expected it to put the template.*With left and right exchanged it does", changed(pose=sides)),
        ("pose without the root's rotation", REFUSED, "is the root's rotation in both", lambda f, base: f | {"pose": np.concatenate([np.float32([[0, 1.5, 0]]), f["pose"][1:]])}),
        ("pose of another frame", REFUSED, "pose: expected it to put the template.*this frame's", of_frame("train/walk.00002.npz", "pose")),
        ("pose with a NaN", REFUSED, "pose: expected finite numbers", put("pose", 3, np.nan)),
        ("translation in millimetres", REFUSED, "is the translation right|translation in metres|millimetres", changed(translation=lambda t: 1000 * (t + 1))),
        ("translation in centimetres", REFUSED, "is the translation right|translation in metres|centimetres", changed(translation=lambda t: 100 * (t + 0.1))),
        ("translation of another frame", REFUSED, "is the translation right", changed(translation=lambda t: t + np.float32([0.2, 0, 0.3]))),
        ("no translation", READ, "", lacking("translation")),
        ("translation alone wrong, body derived", REFUSED, r"expected it over its body.*Moving it by|lies \(", lambda f, base: changed(translation=lambda t: t + 0.3)(lacking("body_verts", "vtransf")(f, base), base)),
        ("body in centimetres", REFUSED, "body: expected about .*centimetres", changed(body_verts=lambda v: 100 * v)),
        ("body in millimetres", REFUSED, "body: expected about .*millimetres", changed(body_verts=lambda v: 1000 * v)),
        ("body and scan in centimetres", REFUSED, "body: expected about .*centimetres", changed(body_verts=lambda v: 100 * v, scan_pc=lambda p: 100 * p)),
        ("body of another frame", REFUSED, "expected it to put the template on the frame's body", of_frame("train/walk.00002.npz", "body_verts")),
        ("body, transforms of another frame", REFUSED, "is the fit of another frame or person", lambda f, base: of_frame("train/walk.00002.npz", "body_verts", "vtransf")(lacking("pose", "translation")(f, base), base)),
        ("body moved by 5 cm", REFUSED, r"Moving it by \(0\.05, ", lambda f, base: lacking("pose", "translation")(changed(body_verts=lambda v: v + np.float32([0.05, 0, 0]))(f, base), base)),
        ("body with another order of vertices", REFUSED, r"body: .*edges are \d+\.\d+ times", changed(body_verts=lambda v: v[::-1])),
        ("body of another count of vertices", REFUSED, r"expected shape \(V, 4, 4\) with V=\d+, got", changed(body_verts=lambda v: v[:-5])),
        ("body with a NaN", REFUSED, "body_verts: expected finite numbers", put("body_verts", 3, np.nan)),
        ("body of a person 1.1 times as tall", REFUSED, r"body: .*edges are 1\.10 times", lambda f, base: lacking("pose", "translation")(changed(body_verts=lambda v: 1.1 * v, scan_pc=lambda p: 1.1 * p)(f, base), base)),
        ("transforms transposed", REFUSED, "vtransf: .*Transposed it does", lambda f, base: lacking("pose")(changed(vtransf=lambda t: np.concatenate([np.swapaxes(t[:, :3, :3], 1, 2), t[:, :3, 3:]], 2))(f, base), base) | {"vtransf": np.swapaxes(f["vtransf"][:, :3, :3], 1, 2)}),
        ("transforms that are the identity", REFUSED, "vtransf: .*It is the identity", changed(vtransf=lambda t: np.tile(np.eye(4, dtype=np.float32), (len(t), 1, 1)))),
        ("transforms of another frame", REFUSED, "vtransf: expected it to turn", of_frame("train/walk.00002.npz", "vtransf")),
        ("transforms of another count", REFUSED, r"vtransf: expected shape \(V, 4, 4\) with V=\d+, got", changed(vtransf=lambda t: t[:-1])),
        ("transforms with row vectors' translations", REFUSED, "vtransf: ", changed(vtransf=lambda t: np.swapaxes(t, 1, 2))),
        ("joint transforms of another frame", REFUSED, "joint_transforms: expected it to put", lambda f, base: f | {"joint_transforms": np.tile(np.eye(4, dtype=np.float32), (22, 1, 1))}),
        ("joint transforms of 24 joints", REFUSED, "joint_transforms: expected 22 rows", lambda f, base: f | {"joint_transforms": np.tile(np.eye(4, dtype=np.float32), (24, 1, 1))}),
        ("scan and body mirrored", REFUSED, "With the template mirrored it does", whole(np.diag([-1.0, 1, 1]))),
        ("scan, body and transforms mirrored", REFUSED, r"determinants are -1\.00: they mirror", lambda f, base: whole(np.diag([-1.0, 1, 1]))(f, base) | {"vtransf": np.diag([-1.0, 1, 1]) @ f["vtransf"][:, :3, :3]}),
        ("body of a person 1.06 times as tall", WARNED, r"body: .*edges are 1\.06 times", lambda f, base: lacking("pose", "translation")(changed(body_verts=lambda v: 1.06 * v, scan_pc=lambda p: 1.06 * p)(f, base), base)),
        ("scan, body and transforms lying (z-up)", READ, "", whole(turn("x", 90))),
    ],
}

# --- bodies: functions of a template's arrays ------------------------------------------------------------------------


def turned_body(linear: np.ndarray) -> Callable:
    """Vertices and joints turned, scaled or mirrored."""
    return lambda body, base: body | {key: (body[key] @ np.transpose(linear)).astype(np.float32) for key in ("vertices", "joints")}


def columns(body: Arrays, base: Base) -> Arrays:
    """Weights whose columns of left and right are exchanged."""
    body["weights"] = body["weights"][:, [SMPL_JOINTS.index(name) for name in swapped_names()]]
    return body


def swapped_names() -> list[str]:
    """SMPL's joints with left and right exchanged."""
    return [n.replace("left", "*").replace("right", "left").replace("*", "right") for n in SMPL_JOINTS]


BODIES = [
    ("as it is", READ, "", lambda body, base: body),
    ("in centimetres", REFUSED, "centimetres", turned_body(100 * np.eye(3))),
    ("in millimetres", REFUSED, "millimetres", turned_body(1000 * np.eye(3))),
    ("in inches", REFUSED, "inches", turned_body(np.eye(3) / 0.0254)),
    ("z up", REFUSED, "Turn body and scans by -90 degrees about x", turned_body(turn("x", 90))),
    ("facing -z", REFUSED, "faces -z", turned_body(turn("y", 180))),
    ("facing x", REFUSED, "degrees about y", turned_body(turn("y", 90))),
    ("upside down", REFUSED, "180 degrees about z", turned_body(turn("z", 180))),
    ("mirrored", REFUSED, "mirrored", turned_body(np.diag([-1, 1, 1]))),
    ("faces wound inward", REFUSED, "faces: .*wound inward.*Swap two columns", lambda b, base: b | {"faces": b["faces"][:, ::-1]}),
    ("half of the faces turned over", REFUSED, "faces: .*not wound one way", lambda b, base: b | {"faces": np.where(np.arange(len(b["faces"]))[:, None] % 2, b["faces"], b["faces"][:, ::-1])}),
    ("faces from 1", REFUSED, "faces: expected vertex indices", lambda b, base: b | {"faces": b["faces"] + 1}),
    ("no faces", REFUSED, "faces: expected triangles", lambda b, base: b | {"faces": b["faces"][:0]}),
    ("faces of another body", REFUSED, "faces: ", lambda b, base: b | {"faces": np.random.default_rng(0).permutation(len(b["vertices"]))[b["faces"]].astype(np.int32)}),
    ("a NaN vertex", REFUSED, "vertices: expected finite numbers", put("vertices", 3, np.nan)),
    ("joints in centimetres", REFUSED, "They look like centimetres", lambda b, base: b | {"joints": 100 * b["joints"]}),
    ("joints moved", REFUSED, "Moving all joints by", lambda b, base: b | {"joints": b["joints"] + np.float32([0, 0.4, 0])}),
    ("joints with left and right exchanged", REFUSED, "left and right look swapped", columns),
    ("joints in another order", REFUSED, "joints: |weights: ", lambda b, base: b | {"joints": b["joints"][::-1]}),
    ("joints as homogeneous coordinates", REFUSED, "joints: expected shape", lambda b, base: b | {"joints": np.pad(b["joints"], ((0, 0), (0, 1)))}),
    ("no joints", READ, "", lambda b, base: {key: value for key, value in b.items() if key != "joints"}),
    ("weights transposed", REFUSED, "weights: expected shape", lambda b, base: b | {"weights": b["weights"].T}),
    ("weights that do not sum to 1", REFUSED, "weights: .*sum", lambda b, base: b | {"weights": b["weights"] * 0.7}),
    ("weights that are negative", REFUSED, "weights: ", put("weights", (3, 2), -0.5)),
    ("weights of zeros", REFUSED, "weights: ", lambda b, base: b | {"weights": 0 * b["weights"]}),
    ("weights with a NaN", REFUSED, "weights: expected finite", put("weights", 3, np.nan)),
    ("no weights", REFUSED, "weights: expected `weights`", lambda b, base: {k: v for k, v in b.items() if k != "weights"}),
    ("parents after their children", REFUSED, "parents: ", lambda b, base: b | {"parents": b["parents"][::-1]}),
    ("parents in a circle", REFUSED, "parents: ", put("parents", 1, 4)),
    ("parents of another tree", REFUSED, "joints: |parents: ", lambda b, base: b | {"parents": np.array([-1] + [0] * 21)}),
    ("a joint's name twice", REFUSED, "joint_names: ", put("joint_names", 2, "left_hip")),
    ("names of fewer joints", REFUSED, "joint_names: ", lambda b, base: b | {"joint_names": b["joint_names"][:-1]}),
    ("as half floats", READ, "", lambda b, base: b | {"vertices": b["vertices"].astype(np.float16)}),
    ("big-endian, in Fortran order", READ, "", lambda b, base: b | {"vertices": np.asfortranarray(b["vertices"].astype(">f8"))}),
    ("of half the height", REFUSED, "scan: .*ividing its positions by (1.9|2)", turned_body(0.5 * np.eye(3))),
]

# --- folders: functions of a folder with a valid outfit ---------------------------------------------------------------


def also(path: str, content: bytes = b"") -> Callable:
    """One more file in the folder."""

    def spoil(folder: Path, base: Base) -> None:
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)

    return spoil


def copied(source: str, target: str, **changes: np.ndarray) -> Callable:
    """A frame once more, under another name."""
    return lambda folder, base: save(folder / target, base.frames[source] | changes)


def without(*patterns: str) -> Callable:
    """The folder without some of its files."""

    def spoil(folder: Path, base: Base) -> None:
        for pattern in patterns:
            for file in folder.glob(pattern):
                shutil.rmtree(file) if file.is_dir() else file.unlink()

    return spoil


def emptied(*splits: str) -> Callable:
    """Split folders without frames."""

    def spoil(folder: Path, base: Base) -> None:
        for split in splits:
            shutil.rmtree(folder / split, ignore_errors=True)
            (folder / split).mkdir()

    return spoil


def truncated(path: str, share: float) -> Callable:
    """A file cut off."""

    def spoil(folder: Path, base: Base) -> None:
        data = (folder / path).read_bytes()
        (folder / path).write_bytes(data[: int(share * len(data))])

    return spoil


def renamed(source: str, target: str) -> Callable:
    return lambda folder, base: (folder / source).rename(folder / target) and None


def all_frames(change: Callable) -> Callable:
    """The same fault in every frame of train."""

    def spoil(folder: Path, base: Base) -> None:
        for path, arrays in base.frames.items():
            if path.startswith("train"):
                save(folder / path, change(base.copy(arrays), base))

    return spoil


APPLE = b"\x00\x05\x16\x07" + bytes(200)
FOLDERS = [
    ("as it is", READ, "", lambda folder, base: None),
    ("no test folder", READ, "", without("test")),
    ("an empty test folder", READ, "", emptied("test")),
    ("an empty interpolation folder", READ, "", emptied("interpolation")),
    ("a test folder with Thumbs.db alone", READ, "", lambda f, base: (emptied("test")(f, base), also("test/Thumbs.db", APPLE)(f, base))),
    ("macOS's ._ files and .DS_Store", READ, "", lambda f, base: (also("train/._walk.00000.npz", APPLE)(f, base), also("train/.DS_Store", APPLE)(f, base), also("._outfit.yaml", APPLE)(f, base))),
    ("desktop.ini and a text file among the frames", READ, "", lambda f, base: (also("train/desktop.ini")(f, base), also("train/notes.txt", b"x")(f, base))),
    ("an empty train folder", REFUSED, r"train: expected frames \(\*\.npz\), found none", emptied("train")),
    ("empty folders alone", REFUSED, r"train: expected frames \(\*\.npz\), found none", emptied("train", "test", "interpolation")),
    ("frames ending in .NPZ", REFUSED, r"found only walk\.00000\.NPZ", lambda f, base: (emptied("train")(f, base), copied("train/walk.00000.npz", "train/walk.00000.NPZ.npz")(f, base), renamed("train/walk.00000.NPZ.npz", "train/walk.00000.NPZ")(f, base))),
    ("frames in folders of their sequences", REFUSED, "found only walk/00000.npz", lambda f, base: (emptied("train")(f, base), copied("train/walk.00000.npz", "train/walk/00000.npz")(f, base))),
    ("a training frame in test, renamed", REFUSED, "1 test frames have the scan of another frame of train", copied("train/walk.00000.npz", "test/other.00000.npz")),
    ("a training frame in test, of the same name", REFUSED, "expected different frames in train and test, 1 are in both", copied("train/walk.00000.npz", "test/walk.00000.npz")),
    ("a training frame twice", WARNED, "1 train frames have the scan of another frame of train", copied("train/walk.00000.npz", "train/other.00000.npz")),
    ("a training scan twice, with another fit", WARNED, "1 train frames have the scan", lambda f, base: copied("train/walk.00000.npz", "train/other.00000.npz", translation=base.frames[FRAME]["translation"] + np.float32([0.001, 0, 0]))(f, base)),
    ("one training frame alone", REFUSED, "validation_share: expected frames left to train on", without("train/walk.0000[12].npz")),
    ("a frame cut off", REFUSED, r"walk\.00000\.npz: expected a valid npz file", truncated(FRAME, 0.7)),
    ("a frame of no bytes", REFUSED, r"walk\.00000\.npz: expected a valid npz file", truncated(FRAME, 0)),
    ("a frame that is text", REFUSED, r"walk\.00000\.npz: expected a valid npz file", also(FRAME, b"1 2 3\n" * 99)),
    ("a frame with accents and a space in its name", READ, "", renamed(FRAME, "train/gehén 1.00000.npz")),
    ("a folder that ends in .npz", REFUSED, r"walk\.00009\.npz: expected an npz file", lambda f, base: (f / "train/walk.00009.npz").mkdir()),
    ("a frame of another body", REFUSED, r"body_verts: expected \d+ rows as in the template, got 100", lambda f, base: save(f / FRAME, lacking("vtransf")(base.frames[FRAME], base) | {"body_verts": base.frames[FRAME]["body_verts"][:100]})),
    ("no body", REFUSED, "expected template.npz or template.obj", without("template.npz")),
    ("a body cut off", REFUSED, r"template\.npz: expected a valid npz file", truncated("template.npz", 0.5)),
    ("outfit.yaml naming a body that is not there", REFUSED, "bodies/mine.npz", also("outfit.yaml", b"body:\n  path: ../bodies/mine.npz\n")),
    ("outfit.yaml with tabs", REFUSED, r"outfit\.yaml", also("outfit.yaml", b"body:\n\tpath: template.npz\n")),
    ("outfit.yaml that is a list", REFUSED, r"outfit\.yaml", also("outfit.yaml", b"- body\n")),
    ("outfit.yaml with a key of another name", REFUSED, r"outfit\.yaml: .*bdoy", also("outfit.yaml", b"bdoy:\n  path: template.npz\n")),
    ("outfit.yaml with betas for a body without shapes", REFUSED, "betas", also("outfit.yaml", b"body:\n  path: template.npz\n  betas: [1, 2]\n")),
    ("outfit.yaml of another format", REFUSED, "expected format outfit/1, got outfit/9", also("outfit.yaml", b"format: outfit/9\n")),
    ("every scan 0.95 times as large", WARNED, r"0\.95 times the body's size.*Others like it", all_frames(moved(0.95 * np.eye(3)))),
    ("every frame the same", WARNED, "2 train frames have the scan of another", all_frames(lambda f, base: f | {key: base.frames[FRAME][key] for key in ("pose", "body_verts", "vtransf", "translation", *ON)})),
]

# --- motions: functions of AMASS's arrays -----------------------------------------------------------------------------


def motion_pose(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """The poses ``(T, 52, 3)`` changed."""

    def spoil(motion: Arrays, base: Base) -> Arrays:
        poses = change(motion["poses"].reshape(len(motion["poses"]), 52, 3))
        return motion | {"poses": poses.reshape(len(poses), -1)}

    return spoil


def exchanged(poses: np.ndarray) -> np.ndarray:
    """Poses whose left and right joints are exchanged."""
    return poses[:, [SMPL_JOINTS.index(name) for name in swapped_names()] + list(range(22, 52))]


MOTIONS = [
    ("as it is", READ, "", lambda motion, base: motion),
    ("y up", REFUSED, "upright along y .*up=y", lambda m, base: m | rotated_motion(m, turn("x", -90))),
    ("upside down", REFUSED, "upright along -z .*up=-z", lambda m, base: m | rotated_motion(m, turn("x", 180))),
    ("in degrees", REFUSED, "degrees", lambda m, base: m | {"poses": np.degrees(m["poses"])}),
    ("as matrices", REFUSED, "These are rotation matrices of 52 joints", lambda m, base: m | {"poses": Rotation.from_rotvec(m["poses"].reshape(-1, 3)).as_matrix().reshape(len(m["poses"]), -1)}),
    ("as quaternions", REFUSED, "These are quaternions", lambda m, base: m | {"poses": Rotation.from_rotvec(m["poses"].reshape(-1, 3)).as_quat().reshape(len(m["poses"]), -1)}),
    ("translations in centimetres", REFUSED, "units=cm", lambda m, base: m | {"trans": 100 * m["trans"]}),
    ("translations in millimetres", REFUSED, "units=mm", lambda m, base: m | {"trans": 1000 * m["trans"]}),
    ("translations of another length", REFUSED, "trans", lambda m, base: m | {"trans": m["trans"][:-1]}),
    ("translations y up, poses z up", WARNED, "turned up without the poses", lambda m, base: m | {"trans": m["trans"] @ turn("x", -90).T}),
    ("left and right exchanged", WARNED, "left", motion_pose(exchanged)),
    ("joints in another order", WARNED, "joints in SMPL's order", motion_pose(lambda p: np.concatenate([p[:, :1], p[:, 1:22][:, ::-1], p[:, 22:]], axis=1))),
    ("poses negated", WARNED, "bends backwards", motion_pose(lambda p: np.concatenate([p[:, :1], -p[:, 1:]], axis=1))),
    ("a NaN", REFUSED, "poses: expected finite", put("poses", (3, 3), np.nan)),
    ("no frame rate", REFUSED, "expected mocap_framerate .*Give fps=", lambda m, base: {k: v for k, v in m.items() if k != "mocap_framerate"}),
    ("a frame rate of 0", REFUSED, "frames per second, got 0", lambda m, base: m | {"mocap_framerate": np.array(0.0)}),
    ("a frame rate as text", READ, "", lambda m, base: m | {"mocap_framerate": np.array("30")}),
    ("no frames", REFUSED, "at least one frame", lambda m, base: m | {"poses": m["poses"][:0], "trans": m["trans"][:0]}),
    ("one frame", READ, "", lambda m, base: m | {"poses": m["poses"][:1], "trans": m["trans"][:1]}),
    ("one frame, flat", READ, "", lambda m, base: m | {"poses": m["poses"][0], "trans": m["trans"][0]}),
    ("poses (T, 52, 3)", READ, "", lambda m, base: m | {"poses": m["poses"].reshape(-1, 52, 3)}),
    ("poses of 23 joints", WARNED, "joints", lambda m, base: m | {"poses": m["poses"][:, : 23 * 3]}),
    ("poses transposed", REFUSED, "poses", lambda m, base: m | {"poses": m["poses"].T}),
    ("big-endian, in Fortran order", READ, "", lambda m, base: m | {"poses": np.asfortranarray(m["poses"].astype(">f4"))}),
    ("as half floats", READ, "", lambda m, base: m | {"poses": m["poses"].astype(np.float16)}),
    ("as Python objects", REFUSED, "Python objects", lambda m, base: m | {"poses": m["poses"].astype(object)}),
    ("no poses", REFUSED, "poses", lambda m, base: {k: v for k, v in m.items() if k != "poses"}),
    ("translations of 1e6 m", REFUSED, "m/s|metres", lambda m, base: m | {"trans": m["trans"] + np.linspace(0, 1e6, len(m["trans"]))[:, None]}),
]


def rotated_motion(motion: Arrays, linear: np.ndarray) -> Arrays:
    """The motion in a turned world."""
    poses = motion["poses"].copy()
    poses[:, :3] = (Rotation.from_matrix(linear) * Rotation.from_rotvec(poses[:, :3])).as_rotvec()
    return {"poses": poses, "trans": motion["trans"] @ np.transpose(linear)}


# --- meshes: bytes of a file, by the vertices, faces and normals of a body --------------------------------------------


@dataclass(frozen=True)
class Shape:
    """A closed mesh: ``vertices (V, 3)``, ``faces (F, 3)``, ``normals (V, 3)``."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray


def obj(shape: Shape, first: int = 1) -> bytes:
    """An OBJ with indices from a first one."""
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in shape.vertices]
    return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in shape.faces + first)]).encode() + b"\n"


def ply(shape: Shape, faces: bool = True, normals: bool = True, count: int | None = None) -> bytes:
    """A binary PLY."""
    names = ("x", "y", "z", *(("nx", "ny", "nz") if normals else ()))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count or len(shape.vertices)}\n"
    header += "".join(f"property float {name}\n" for name in names)
    if faces:
        header += f"element face {len(shape.faces)}\nproperty list uchar int vertex_indices\n"
    rows = np.concatenate([shape.vertices, shape.normals], axis=1) if normals else shape.vertices
    data = (header + "end_header\n").encode() + rows.astype("<f4").tobytes()
    table = np.zeros(len(shape.faces), [("n", "u1"), ("i", "<i4", 3)])
    table["n"], table["i"] = 3, shape.faces
    return data + (table.tobytes() if faces else b"")


def glb(shape: Shape, **more: object) -> bytes:
    """A GLB of one mesh; ``more`` goes into its document, ``kind`` is the type of its positions."""
    kind = more.pop("kind", 5126)
    places = shape.vertices.astype("<f4") if kind == 5126 else (1000 * shape.vertices).astype("<i2")
    places = np.pad(places, ((0, 0), (0, 0 if kind == 5126 else 1)))
    data = places.tobytes() + shape.faces.astype("<u4").tobytes()
    stride = {} if kind == 5126 else {"byteStride": 8}
    views = [{"buffer": 0, "byteLength": places.nbytes, **stride}]
    views.append({"buffer": 0, "byteOffset": places.nbytes, "byteLength": len(data) - places.nbytes})
    accessors = [{"bufferView": 0, "componentType": kind, "count": len(places), "type": "VEC3"}]
    accessors.append({"bufferView": 1, "componentType": 5125, "count": shape.faces.size, "type": "SCALAR"})
    primitive = {"attributes": {"POSITION": 0}, "indices": 1} | more.pop("primitive", {})
    document = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(data)}], "bufferViews": views}
    document |= {"accessors": accessors, "meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}]}
    text = json.dumps(document | {"scene": 0, "scenes": [{"nodes": [0]}]} | more).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(data)
    parts = struct.pack("<III", 0x46546C67, 2, size), struct.pack("<II", len(text), 0x4E4F534A), text
    return b"".join(parts) + struct.pack("<II", len(data), 0x004E4942) + data


def stl(shape: Shape, count: int | None = None) -> bytes:
    """A binary STL."""
    rows = np.zeros(len(shape.faces), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    rows["v"] = shape.vertices[shape.faces]
    return bytes(80) + struct.pack("<I", len(rows) if count is None else count) + rows.tobytes()


def with_vertex(shape: Shape, value: float) -> Shape:
    """The mesh with one vertex at a value."""
    vertices = shape.vertices.copy()
    vertices[5] = value
    return Shape(vertices, shape.faces, shape.normals)


DRACO = {"primitive": {"extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}}}
DRACO |= {"extensionsUsed": ["KHR_draco_mesh_compression"], "extensionsRequired": ["KHR_draco_mesh_compression"]}
QUANTISED = {"extensionsUsed": ["KHR_mesh_quantization"], "extensionsRequired": ["KHR_mesh_quantization"]}
MESHES = [
    ("an OBJ as it is", READ, "", ".obj", obj),
    ("an OBJ without faces", REFUSED, r"expected triangles, got a point cloud of \d+ points|normals", ".obj", lambda s: obj(Shape(s.vertices, s.faces[:0], s.normals))),
    ("an OBJ with indices from 0", REFUSED, "points to vertex 0 of", ".obj", lambda s: obj(s, 0)),
    ("an OBJ with a decimal comma", REFUSED, "obj", ".obj", lambda s: obj(s).replace(b".", b",")),
    ("an OBJ in UTF-16", REFUSED, "UTF-16", ".obj", lambda s: obj(s).decode().encode("utf-16")),
    ("an OBJ with a NaN vertex", REFUSED, "finite", ".obj", lambda s: obj(with_vertex(s, np.nan))),
    ("an OBJ cut off", READ, "", ".obj", lambda s: obj(s)[: len(obj(s)) // 2 * 2 - 9]),
    ("a PLY as it is", READ, "", ".ply", ply),
    ("a PLY of points, given as a mesh", REFUSED, r"expected triangles, got a point cloud of \d+ points.*reconstruct", ".ply", lambda s: ply(s, faces=False)),
    ("a PLY of points without normals", REFUSED, r"expected triangles, got a point cloud", ".ply", lambda s: ply(s, faces=False, normals=False)),
    ("a PLY cut off", REFUSED, "ply", ".ply", lambda s: ply(s)[:-400]),
    ("a PLY that declares more vertices", REFUSED, "ply", ".ply", lambda s: ply(s, count=10**9)),
    ("a PLY with an infinite vertex", REFUSED, "finite", ".ply", lambda s: ply(with_vertex(s, np.inf))),
    ("a PLY with indices out of range", REFUSED, "indices", ".ply", lambda s: ply(Shape(s.vertices, s.faces + 9, s.normals))),
    ("a PLY with normals of no length", READ, "", ".ply", lambda s: ply(Shape(s.vertices, s.faces, 0 * s.normals))),
    ("a PLY of triangles without area", REFUSED, "triangles with area", ".ply", lambda s: ply(Shape(0 * s.vertices, s.faces, s.normals))),
    ("a GLB as it is", READ, "", ".glb", glb),
    ("a GLB with Draco's compression", REFUSED, "raco.*gltf-transform", ".glb", lambda s: glb(s, **json.loads(json.dumps(DRACO)))),
    ("a GLB with quantised positions", REFUSED, "quanti.*gltf-transform", ".glb", lambda s: glb(s, kind=5122, **QUANTISED)),
    ("a GLB without its buffer", REFUSED, "glb", ".glb", lambda s: glb(s)[:-400]),
    ("an STL as it is", READ, "", ".stl", stl),
    ("an STL of no triangles", REFUSED, "no vertices|triangles", ".stl", lambda s: stl(Shape(s.vertices, s.faces[:0], s.normals))),
    ("an STL cut off", REFUSED, "stl", ".stl", lambda s: stl(s)[:-77]),
    ("an FBX", REFUSED, "ending in", ".fbx", obj),
    ("an empty file", REFUSED, "at least 1 bytes, got 0", ".ply", lambda s: b""),
    ("a picture named .obj", REFUSED, "obj", ".obj", lambda s: b"\x89PNG\r\n\x1a\n" + bytes(300)),
]


# --- the trial --------------------------------------------------------------------------------------------------------


def all_spoilt() -> list[Spoilt]:
    """Every way to spoil data, part by part."""
    found = [Spoilt(part, *row) for part, rows in FRAMES.items() for row in rows]
    found += [Spoilt(part, *row) for part, rows in (("body", BODIES), ("folder", FOLDERS), ("motion", MOTIONS)) for row in rows]
    return found + [Spoilt("mesh", *row[:3], row[3:]) for row in MESHES]


@contextmanager
def recorded() -> Iterator[list[str]]:
    """Warnings of the package within the block."""
    found: list[str] = []

    class Recorder(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record.getMessage())

    log, handler = logging.getLogger("avatar"), Recorder(logging.WARNING)
    log.addHandler(handler)
    try:
        yield found
    finally:
        log.removeHandler(handler)


def read_spoilt(spoilt: Spoilt, base: Base, folder: Path) -> Result:
    """Spoils data in a folder, reads it as the commands do, and records what came of it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    untyped = ""
    with recorded() as warnings:
        try:
            READERS[spoilt.part](spoilt, base, folder)
            outcome, message = (WARNED, " ".join(warnings)) if warnings else (READ, "")
        except AvatarError as error:
            outcome, message = REFUSED, str(error)
        except Exception as error:
            outcome, message, untyped = REFUSED, repr(error), type(error).__name__
    return Result(spoilt, outcome, message.replace(f"{folder}/", ""), untyped)


def _read_frame(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "template.npz", base.body)
    save(folder / FRAME, spoilt.spoil(base.copy(base.frames[FRAME]), base))
    open_outfit_folder(folder).load("train", "walk.00000")


def _read_body(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "template.npz", spoilt.spoil(base.copy(base.body), base))
    save(folder / FRAME, {k: v for k, v in base.frames[FRAME].items() if k not in ("body_verts", "vtransf")})
    open_outfit_folder(folder).load("train", "walk.00000")


def _read_folder(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "template.npz", base.body)
    for path, arrays in base.frames.items():
        save(folder / path, arrays)
    spoilt.spoil(folder, base)
    outfit = open_outfit_folder(folder)
    split_outfit(outfit)
    for split in SPLITS:
        for name in outfit.frames(split) if outfit.has_frames(split) else ():
            outfit.load(split, name)


def _read_motion(spoilt: Spoilt, base: Base, folder: Path) -> None:
    save(folder / "walk.npz", spoilt.spoil(base.copy(base.motion), base))
    read_motion(folder / "walk.npz")


def _read_mesh(spoilt: Spoilt, base: Base, folder: Path) -> None:
    ending, write = spoilt.spoil
    vertices, faces = base.body["vertices"], base.body["faces"].astype(np.int64)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    (folder / f"scan{ending}").write_bytes(write(Shape(vertices, faces, normals)))
    assert read_surface(folder / f"scan{ending}").mesh is not None


READERS = dict(scan=_read_frame, fit=_read_frame, body=_read_body, folder=_read_folder, motion=_read_motion, mesh=_read_mesh)


def spoilt_trial(root: Path) -> list[Finding]:
    """Reads data spoilt in every way, and counts what came of it; the table goes to ``<root>/spoilt_data.md``."""
    base = Base(root)
    results = [read_spoilt(spoilt, base, root / "data") for spoilt in all_spoilt()]
    (root / "spoilt_data.md").write_text(spoilt_table(results))
    counts = Counter(result.outcome for result in results if result.met)
    wanted = Counter(result.spoilt.wanted for result in results)
    total = len(results)
    return [
        *(all_of("spoilt", f"{outcome}, as it should be", counts[outcome], wanted[outcome]) for outcome in wanted),
        none_of("spoilt", "accepted in silence", sum(r.outcome == READ != r.spoilt.wanted for r in results), total),
        none_of("spoilt", "refused with an untyped error", sum(bool(r.untyped) for r in results), total),
    ]


def spoilt_table(results: list[Result]) -> str:
    """What was spoilt and what came of it, as Markdown."""
    lines = ["| part | what was spoilt | came of it | message |", "|---|---|---|---|"]
    for result in results:
        message = re.sub(r"\s+", " ", result.message).replace("|", "\\|")
        lines.append(f"| {result.spoilt.part} | {result.spoilt.words} | {result.outcome} | {message} |")
    return "\n".join(lines) + "\n"
