"""Faults of scans: functions of the arrays of a packed frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avatar.body.model import SMPL_JOINTS
from avatar.geometry.trees import build_tree
from reliability.spoilt import READ, REFUSED, WARNED, Arrays, Base, put, turn


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


def plane(width: float, level: str) -> Callable:
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
        tree, found = build_tree(scan), []
        while len(found) < count:
            point = scan[rng.integers(len(scan))] + rng.normal(size=3) * far
            if near < tree.query(point)[0] < far:
                found.append(point)
        return np.array(found), np.tile([0.0, 1.0, 0.0], (count, 1))

    return make


def at_origin(count: int) -> Callable:
    """Points at (0, 0, 0)."""
    return lambda scan, rng: (np.zeros((count, 3)), np.tile([0.0, 0.0, 1.0], (count, 1)))


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


def bone(name: str, radius: float) -> Callable:
    """Which points are farther than a radius from a joint."""

    def which(points: np.ndarray, base: Base) -> np.ndarray:
        index = SMPL_JOINTS.index(name)
        place = base.joints[index] @ np.append(base.body["joints"][index], 1)
        return np.linalg.norm(points - place[:3], axis=1) > radius

    return which


FAR_PLACE = np.array([0.0, 900.0, 2500.0], np.float32)
ON = ("scan_pc", "scan_n")
SCANS = [
    ("as it is", READ, "", lambda frame, base: frame),
    ("in centimetres", REFUSED, "scan: expected about .*centimetres: divide", moved(100 * np.eye(3))),
    ("in millimetres", REFUSED, "millimetres: divide .* by 1000", moved(1000 * np.eye(3))),
    ("in inches", REFUSED, r"inches: divide .* by 39\.37", moved(np.eye(3) / 0.0254)),
    ("in kilometres", REFUSED, "multiply positions and translations by 1000", moved(np.eye(3) / 1000)),
    (
        "0.7 times as large",
        REFUSED,
        r"Dividing its positions by 0\.70",
        moved(0.7 * np.eye(3)),
    ),
    (
        "0.9 times as large",
        REFUSED,
        r"0\.90 times the body's size.*Divide its positions by 0\.90",
        moved(0.9 * np.eye(3)),
    ),
    ("0.95 times as large", WARNED, r"0\.95 times the body's size", moved(0.95 * np.eye(3))),
    ("1.05 times as large", WARNED, r"1\.05 times the body's size", moved(1.05 * np.eye(3))),
    ("1.1 times as large", REFUSED, r"1\.10 times the body's size", moved(1.1 * np.eye(3))),
    ("1.3 times as large", REFUSED, r"ividing its positions by 1\.(29|3)", moved(1.3 * np.eye(3))),
    ("1.6 times as large", REFUSED, r"ividing its positions by 1\.(59|6)", moved(1.6 * np.eye(3))),
    (
        "moved by 3.5 cm to the side",
        WARNED,
        r"lies \(0\.03, .*m from it|lies \(0\.04, .*m from it",
        moved(np.eye(3), (0.035, 0, 0)),
    ),
    (
        "moved by 5 cm to the side",
        REFUSED,
        r"lies \(0\.05, .*m from it|Moving it by \(-0\.05, ",
        moved(np.eye(3), (0.05, 0, 0)),
    ),
    (
        "moved by 5 cm up",
        REFUSED,
        r"lies \(-?0\.00, 0\.05, .*m from it|Moving it by \(-?0\.00, -0\.05, ",
        moved(np.eye(3), (0, 0.05, 0)),
    ),
    ("moved by 10 cm", REFUSED, r"Moving it by \(-0\.10", moved(np.eye(3), (0.1, 0, 0))),
    ("moved by 50 cm", REFUSED, r"Moving it by \(-0\.(49|5)", moved(np.eye(3), (0.5, 0, 0))),
    ("moved by 3.6 m", REFUSED, r"Moving it by \(-3\.\d\d, .*, -2\.\d\d\)", moved(np.eye(3), (3, 0, 2))),
    ("moved by a translation in millimetres", REFUSED, "is the translation in metres", moved(np.eye(3), FAR_PLACE)),
    *(
        (
            f"turned by 5 degrees about {axis}",
            WARNED,
            r"turned by 5 degrees about",
            moved(turn(axis, 5), about=True),
        )
        for axis in "xyz"
    ),
    *(
        (
            f"turned by 20 degrees about {axis}",
            REFUSED,
            r"[Tt]urn(ed|ing the scan) by (19|20) degrees about",
            moved(turn(axis, 20), about=True),
        )
        for axis in "xyz"
    ),
    *(
        (
            f"turned by {angle} degrees about {axis}",
            REFUSED,
            f"Turning the scan by {back} degrees about {axis}",
            moved(turn(axis, angle), about=True),
        )
        for angle, back in ((90, -90), (180, 180))
        for axis in "xyz"
    ),
    (
        "turned by 180 degrees about y and moved",
        REFUSED,
        r"Turning the scan by 180 degrees about y and moving",
        moved(turn("y", 180), (0.5, 0, 1)),
    ),
    ("mirrored", REFUSED, r"Mirroring the scan \(x to -x\)", moved(np.diag([-1, 1, 1]))),
    ("mirrored, y and z swapped", REFUSED, r"Swapping y and z of the scan|Mirroring", moved(np.eye(3)[[0, 2, 1]])),
    ("in feet", REFUSED, r"feet: divide .* by 3\.2808", moved(np.eye(3) / 0.3048)),
    ("1.2 times as wide", WARNED, "head, hands and feet lie .*Is the fit right", moved(np.diag([1.2, 1, 1]))),
    ("1.15 times as high", WARNED, r"1\.1\d times the body's size|Is the fit right", moved(np.diag([1, 1.15, 1]))),
    ("moved by 15 cm down", REFUSED, r"Moving it by \(-?0\.00, 0\.15", moved(np.eye(3), (0, -0.15, 0))),
    ("turned by 135 degrees about y", REFUSED, "Turning the scan by 135 degrees", moved(turn("y", 135), about=True)),
    ("with x, y and z in another order", REFUSED, r"Taking \(z, x, y\) for \(x, y, z\)", moved(np.eye(3)[[1, 2, 0]])),
    ("with its columns sorted", REFUSED, "another frame or person", changed(scan_pc=lambda p: np.sort(p, axis=0))),
    ("of another frame", REFUSED, "is the fit of another frame or person", of_frame("train/walk.00002.npz", *ON)),
    ("of a taller person", REFUSED, r"1\.10 times .*another person's shape", moved(1.1 * np.eye(3), about=True)),
    (
        "without what is below the waist",
        REFUSED,
        "part of the person missing",
        kept(lambda p, base: p[:, 1] > np.median(p[:, 1])),
    ),
    (
        "without its left half",
        REFUSED,
        "part of the person missing",
        kept(lambda p, base: p[:, 0] < np.median(p[:, 0])),
    ),
    ("without the head", WARNED, r"head, hands and feet lie .* cm.*missing or covered", kept(bone("head", 0.25))),
    (
        "without a hand",
        WARNED,
        r"head, hands and feet lie .* cm.*missing or covered",
        kept(bone("left_wrist", 0.2)),
    ),
    ("with holes of 8 cm", READ, "", kept(lambda p, base: build_tree(p[:: len(p) // 6]).query(p)[0] > 0.04)),
    ("of 50 points", REFUSED, "at least 100 points, got 50", kept(lambda p, base: np.arange(len(p)) < 50)),
    ("of no points", REFUSED, "at least 100 points, got 0", kept(lambda p, base: np.zeros(len(p), bool))),
    (
        "with all points at one place",
        REFUSED,
        "scan: expected about",
        changed(scan_pc=lambda p: np.tile(p[:1], (len(p), 1))),
    ),
    ("with a floor of 3 m", REFUSED, "lie apart from the body on a plane.*floor or wall", added(plane(3, "floor"))),
    ("with a floor of 1 m", REFUSED, "lie apart from the body on a plane.*floor or wall", added(plane(1, "floor"))),
    ("with a wall behind", REFUSED, "lie apart from the body on a plane.*floor or wall", added(plane(2, "wall"))),
    ("with a second person beside", REFUSED, "50.00% lie apart|another person or furniture", beside(1.2)),
    ("with a second person 5 m away", REFUSED, "another person or furniture", beside(5.0)),
    ("with a second person at 50 cm", REFUSED, "beside the body and look at it.*touching", beside(0.5)),
    ("with a second person at 80 cm", REFUSED, "another person or furniture", beside(0.8)),
    ("with a floor of 60 cm", REFUSED, "lie apart from the body on a plane.*floor or wall", added(plane(0.6, "floor"))),
    (
        "with pixels without depth",
        REFUSED,
        "5% of them lie at one and the same place.*without depth",
        added(at_origin(210)),
    ),
    ("with 3 points at the origin", WARNED, "3 points lie exactly at the origin", added(at_origin(3))),
    ("with a box beside", REFUSED, "another person or furniture", added(box)),
    ("with 5 stray points at 5 m", REFUSED, r"5 of 4005 points .*stray points", added(strays(5, 3, 6))),
    ("with 1 stray point at 100 m", REFUSED, r"1 of 4001 points .*stray points", added(strays(1, 80, 110))),
    ("with 10 stray points at 3 dm", REFUSED, r"10 of 4010 points .*stray points", added(strays(10, 0.27, 0.35))),
    ("with 1 stray point at 3 dm", WARNED, r"1 of 4001 points .*stray points", added(strays(1, 0.27, 0.33))),
    ("with a point at 1e30", REFUSED, r"1 of 4000 points .*e\+30 m", put("scan_pc", 7, 1e30)),
    ("with a NaN point", REFUSED, "scan_pc: expected finite numbers, got 3 NaN", put("scan_pc", 7, np.nan)),
    ("with an infinite coordinate", REFUSED, "scan_pc: expected finite numbers", put("scan_pc", (7, 1), np.inf)),
    ("with a NaN normal", REFUSED, "scan_n: expected finite numbers", put("scan_n", 7, np.nan)),
    ("with a normal of no length", REFUSED, "scan normals: expected unit length, got 0 ", put("scan_n", 7, 0)),
    ("with normals of length 2", READ, "", changed(scan_n=lambda n: 2 * n)),
    ("with normals inward", REFUSED, "multiply its normals by -1", changed(scan_n=lambda n: -n)),
    ("with normals either way", REFUSED, r"only \d\d% do\. Orient them", flipped(0.5)),
    ("with a fifth of the normals inward", WARNED, r"only (7|8)\d% do", flipped(0.2)),
    (
        "with normals of another order",
        REFUSED,
        r"only \d\d% do|do not fit",
        changed(scan_n=lambda n: np.random.default_rng(0).permutation(n)),
    ),
    (
        "with normals still z-up",
        REFUSED,
        r"scan normals: .*turned alike",
        changed(scan_n=lambda n: n @ turn("x", 90).T),
    ),
    (
        "with normals all upward",
        REFUSED,
        r"scan normals",
        changed(scan_n=lambda n: np.tile(np.float32([0, 1, 0]), (len(n), 1))),
    ),
    (
        "with every point twice",
        READ,
        "",
        changed(scan_pc=lambda p: np.repeat(p, 2, 0), scan_n=lambda n: np.repeat(n, 2, 0)),
    ),
    (
        "with noise of 2 mm",
        READ,
        "",
        changed(scan_pc=lambda p: p + np.random.default_rng(0).normal(scale=0.002, size=p.shape)),
    ),
    (
        "with noise of 1.5 cm",
        WARNED,
        "scan: .*off an even layer.*noise",
        changed(scan_pc=lambda p: p + np.random.default_rng(0).normal(scale=0.015, size=p.shape)),
    ),
    (
        "with noise of 3 cm",
        REFUSED,
        "lies deep inside. That is noise",
        changed(scan_pc=lambda p: p + np.random.default_rng(0).normal(scale=0.03, size=p.shape)),
    ),
    (
        "with points and normals of other counts",
        REFUSED,
        "scan_n: expected shape",
        changed(scan_n=lambda n: n[:-1]),
    ),
    ("as doubles", READ, "", changed(scan_pc=lambda p: p.astype(np.float64))),
    ("as half floats", READ, "", changed(scan_pc=lambda p: p.astype(np.float16))),
    (
        "as half floats, 5 m from the origin",
        REFUSED,
        r"scan_pc: .*float16 rounds those at \d",
        lambda f, base: away(f, 5, np.float16),
    ),
    (
        "10 km from the origin",
        WARNED,
        r"float32 rounds those at 1e\+04 m to 0.00098 m",
        lambda f, base: away(f, 1e4, np.float64),
    ),
    (
        "1000 km from the origin",
        REFUSED,
        r"float32 rounds those at 1e\+06 m",
        lambda f, base: away(f, 1e6, np.float64),
    ),
    ("big-endian", READ, "", changed(scan_pc=lambda p: p.astype(">f4"), scan_n=lambda n: n.astype(">f8"))),
    ("in Fortran order", READ, "", changed(scan_pc=np.asfortranarray)),
    (
        "as whole millimetres",
        REFUSED,
        "scan_pc: expected float, got int",
        changed(scan_pc=lambda p: (1000 * p).astype(np.int32)),
    ),
    (
        "as complex numbers",
        REFUSED,
        "scan_pc: expected float, got complex",
        changed(scan_pc=lambda p: p.astype(np.complex64)),
    ),
    ("as one number", REFUSED, "scan_pc: expected shape", changed(scan_pc=lambda p: p[0, 0])),
    ("transposed", REFUSED, r"scan_pc: expected shape \(M, 3\), got \(3, 4000\)", changed(scan_pc=lambda p: p.T)),
    (
        "in homogeneous coordinates",
        REFUSED,
        r"scan_pc: expected shape \(M, 3\), got \(4000, 4\)",
        changed(scan_pc=lambda p: np.pad(p, ((0, 0), (0, 1)))),
    ),
    ("in a batch of one", REFUSED, r"scan_pc: expected shape", changed(scan_pc=lambda p: p[None])),
    (
        "as Python objects",
        REFUSED,
        "scan_pc: expected float, found Python objects",
        changed(scan_pc=lambda p: p.astype(object)),
    ),
    ("without normals", REFUSED, "expected the keys scan_n", lacking("scan_n")),
    (
        "under other keys",
        REFUSED,
        "expected the keys scan_pc, .*found only: .*points",
        lambda f, base: lacking("scan_pc")(f | {"points": f["scan_pc"]}, base),
    ),
    ("a mesh", READ, "", with_mesh(lambda f: f)),
    ("a mesh of no faces", READ, "", with_mesh(lambda f: f | {"scan_faces": f["scan_faces"][:0]})),
    (
        "a mesh wound inward",
        REFUSED,
        r"scan faces: .*wound inward \(swap two",
        with_mesh(lambda f: f | {"scan_faces": f["scan_faces"][:, ::-1]}),
    ),
    (
        "a mesh, mirrored",
        REFUSED,
        r"Mirroring the scan \(x to -x\)",
        with_mesh(lambda f: moved(np.diag([-1, 1, 1]))(f, None)),
    ),
    (
        "a mesh with a third of its faces turned over",
        REFUSED,
        r"scan faces: .*3\d% are not",
        with_mesh(
            lambda f: (
                f
                | {
                    "scan_faces": np.where(
                        np.arange(len(f["scan_faces"]))[:, None] % 3, f["scan_faces"], f["scan_faces"][:, ::-1]
                    )
                }
            )
        ),
    ),
    (
        "a mesh with a tenth of its faces turned over",
        WARNED,
        r"scan faces: .*1\d% are not",
        with_mesh(
            lambda f: (
                f
                | {
                    "scan_faces": np.where(
                        np.arange(len(f["scan_faces"]))[:, None] % 8, f["scan_faces"], f["scan_faces"][:, ::-1]
                    )
                }
            )
        ),
    ),
    (
        "a mesh with faces of another",
        REFUSED,
        "scan faces: .*Are they this scan's",
        with_mesh(
            lambda f: f | {"scan_faces": np.random.default_rng(0).permutation(len(f["scan_pc"]))[f["scan_faces"]]}
        ),
    ),
    (
        "a mesh with faces from 1",
        REFUSED,
        r"scan_faces: expected indices in \[0",
        with_mesh(lambda f: f | {"scan_faces": f["scan_faces"] + 1}),
    ),
    (
        "a mesh with faces of floats",
        REFUSED,
        "scan_faces: expected int, got float",
        with_mesh(lambda f: f | {"scan_faces": f["scan_faces"].astype(np.float32)}),
    ),
    (
        "a mesh of quads",
        REFUSED,
        r"scan_faces: expected shape \(F, 3\)",
        with_mesh(lambda f: f | {"scan_faces": np.pad(f["scan_faces"], ((0, 0), (0, 1)))}),
    ),
    (
        "with colours from 0 to 255 as floats",
        REFUSED,
        "colours from 0 to 1, got 200",
        lambda f, base: f | {"scan_colors": np.full((len(f["scan_pc"]), 3), 200.0)},
    ),
]
