"""Faults of bodies and folders: functions of a template's arrays, and of an outfit's folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from reliability.spoilt import FRAME, READ, REFUSED, WARNED, Arrays, Base, put, save, swapped, turn
from reliability.spoilt_scans import ON, lacking, moved


def turned_body(linear: np.ndarray) -> Callable:
    """Vertices and joints turned, scaled or mirrored."""
    return lambda body, base: (
        body | {key: (body[key] @ np.transpose(linear)).astype(np.float32) for key in ("vertices", "joints")}
    )


def columns(body: Arrays, base: Base) -> Arrays:
    """Weights whose columns of left and right are exchanged."""
    body["weights"] = body["weights"][:, swapped()]
    return body


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
    (
        "faces wound inward",
        REFUSED,
        "faces: .*wound inward.*Swap two columns",
        lambda b, base: b | {"faces": b["faces"][:, ::-1]},
    ),
    (
        "half of the faces turned over",
        REFUSED,
        "faces: .*not wound one way",
        lambda b, base: (
            b | {"faces": np.where(np.arange(len(b["faces"]))[:, None] % 2, b["faces"], b["faces"][:, ::-1])}
        ),
    ),
    ("faces from 1", REFUSED, "faces: expected vertex indices", lambda b, base: b | {"faces": b["faces"] + 1}),
    ("no faces", REFUSED, "faces: expected triangles", lambda b, base: b | {"faces": b["faces"][:0]}),
    (
        "faces of another body",
        REFUSED,
        "faces: ",
        lambda b, base: (
            b | {"faces": np.random.default_rng(0).permutation(len(b["vertices"]))[b["faces"]].astype(np.int32)}
        ),
    ),
    ("a NaN vertex", REFUSED, "vertices: expected finite numbers", put("vertices", 3, np.nan)),
    ("joints in centimetres", REFUSED, "They look like centimetres", lambda b, base: b | {"joints": 100 * b["joints"]}),
    (
        "joints moved",
        REFUSED,
        "Moving all joints by",
        lambda b, base: b | {"joints": b["joints"] + np.float32([0, 0.4, 0])},
    ),
    ("joints with left and right exchanged", REFUSED, "left and right look swapped", columns),
    ("joints in another order", REFUSED, "joints: |weights: ", lambda b, base: b | {"joints": b["joints"][::-1]}),
    (
        "joints as homogeneous coordinates",
        REFUSED,
        "joints: expected shape",
        lambda b, base: b | {"joints": np.pad(b["joints"], ((0, 0), (0, 1)))},
    ),
    (
        "no joints",
        WARNED,
        r"0\.96 times the body's size",
        lambda b, base: {key: value for key, value in b.items() if key != "joints"},
    ),
    ("weights transposed", REFUSED, "weights: expected shape", lambda b, base: b | {"weights": b["weights"].T}),
    ("weights that do not sum to 1", REFUSED, "weights: .*sum", lambda b, base: b | {"weights": b["weights"] * 0.7}),
    ("weights that are negative", REFUSED, "weights: ", put("weights", (3, 2), -0.5)),
    ("weights of zeros", REFUSED, "weights: ", lambda b, base: b | {"weights": 0 * b["weights"]}),
    ("weights with a NaN", REFUSED, "weights: expected finite", put("weights", 3, np.nan)),
    (
        "no weights",
        REFUSED,
        "weights: expected `weights`",
        lambda b, base: {k: v for k, v in b.items() if k != "weights"},
    ),
    ("parents after their children", REFUSED, "parents: ", lambda b, base: b | {"parents": b["parents"][::-1]}),
    ("parents in a circle", REFUSED, "parents: ", put("parents", 1, 4)),
    (
        "parents of another tree",
        REFUSED,
        "joints: |parents: ",
        lambda b, base: b | {"parents": np.array([-1] + [0] * 21)},
    ),
    ("a joint's name twice", REFUSED, "joint_names: ", put("joint_names", 2, "left_hip")),
    (
        "names in capitals",
        REFUSED,
        "got 'PELVIS'",
        lambda b, base: b | {"joint_names": np.char.upper(b["joint_names"])},
    ),
    (
        "names in another order",
        REFUSED,
        "joint_names are in another order",
        lambda b, base: b | {"joint_names": b["joint_names"][::-1]},
    ),
    (
        "names of left and right exchanged",
        REFUSED,
        "joint_names have left and right exchanged",
        lambda b, base: b | {"joint_names": b["joint_names"][swapped()]},
    ),
    (
        "weights of the root alone",
        REFUSED,
        "weights: expected vertices that follow each joint, none follows left_hip",
        lambda b, base: b | {"weights": np.eye(22, dtype=np.float32)[np.zeros(len(b["weights"]), int)]},
    ),
    (
        "weights in another order of vertices",
        REFUSED,
        "joints: expected each where the weights of its subtree end",
        lambda b, base: b | {"weights": b["weights"][::-1]},
    ),
    (
        "every face twice",
        REFUSED,
        "faces: expected each once",
        lambda b, base: b | {"faces": np.tile(b["faces"], (2, 1))},
    ),
    (
        "100 km from the origin",
        REFUSED,
        "vertices: expected a body near the origin",
        lambda b, base: b | {key: b[key].astype(np.float64) + 1e5 for key in ("vertices", "joints")},
    ),
    ("1.06 times as tall", WARNED, r"0\.94 times the body's size", turned_body(1.06 * np.eye(3))),
    ("names of fewer joints", REFUSED, "joint_names: ", lambda b, base: b | {"joint_names": b["joint_names"][:-1]}),
    ("as half floats", READ, "", lambda b, base: b | {"vertices": b["vertices"].astype(np.float16)}),
    (
        "big-endian, in Fortran order",
        READ,
        "",
        lambda b, base: b | {"vertices": np.asfortranarray(b["vertices"].astype(">f8"))},
    ),
    ("of half the height", REFUSED, "scan: .*ividing its positions by (1.9|2)", turned_body(0.5 * np.eye(3))),
]


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


def as_obj(change: Callable[[Arrays], Arrays]) -> Callable:
    """An outfit whose body is a ``template.obj`` alone, and whose frames bring vertices and transforms."""

    def spoil(folder: Path, base: Base) -> None:
        body = change(base.copy(base.body))
        lines = [f"v {x} {y} {z}" for x, y, z in body["vertices"]] + [f"f {a} {b} {c}" for a, b, c in body["faces"] + 1]
        (folder / "template.npz").unlink()
        (folder / "template.obj").write_text("\n".join(lines))
        for path, arrays in base.frames.items():
            save(folder / path, {key: arrays[key] for key in (*ON, "body_verts", "vtransf")})

    return spoil


APPLE = b"\x00\x05\x16\x07" + bytes(200)
FOLDERS = [
    ("as it is", READ, "", lambda folder, base: None),
    ("no test folder", READ, "", without("test")),
    ("an empty test folder", READ, "", emptied("test")),
    ("an empty interpolation folder", READ, "", emptied("interpolation")),
    (
        "a test folder with Thumbs.db alone",
        READ,
        "",
        lambda f, base: (emptied("test")(f, base), also("test/Thumbs.db", APPLE)(f, base)),
    ),
    (
        "macOS's ._ files and .DS_Store",
        READ,
        "",
        lambda f, base: (
            also("train/._walk.00000.npz", APPLE)(f, base),
            also("train/.DS_Store", APPLE)(f, base),
            also("._outfit.yaml", APPLE)(f, base),
        ),
    ),
    (
        "desktop.ini and a text file among the frames",
        READ,
        "",
        lambda f, base: (also("train/desktop.ini")(f, base), also("train/notes.txt", b"x")(f, base)),
    ),
    ("an empty train folder", REFUSED, r"train: expected frames \(\*\.npz\), found none", emptied("train")),
    (
        "empty folders alone",
        REFUSED,
        r"train: expected frames \(\*\.npz\), found none",
        emptied("train", "test", "interpolation"),
    ),
    (
        "frames ending in .NPZ",
        REFUSED,
        r"found only walk\.00000\.NPZ",
        lambda f, base: (
            emptied("train")(f, base),
            copied("train/walk.00000.npz", "train/walk.00000.NPZ.npz")(f, base),
            renamed("train/walk.00000.NPZ.npz", "train/walk.00000.NPZ")(f, base),
        ),
    ),
    (
        "frames in folders of their sequences",
        REFUSED,
        "found only walk/00000.npz",
        lambda f, base: (emptied("train")(f, base), copied("train/walk.00000.npz", "train/walk/00000.npz")(f, base)),
    ),
    (
        "a training frame in test, renamed",
        REFUSED,
        "1 test frames have the scan of another frame of train",
        copied("train/walk.00000.npz", "test/other.00000.npz"),
    ),
    (
        "a training frame in test, of the same name",
        REFUSED,
        "expected different frames in train and test, 1 are in both",
        copied("train/walk.00000.npz", "test/walk.00000.npz"),
    ),
    (
        "a training frame twice",
        WARNED,
        "1 train frames have the scan of another frame of train",
        copied("train/walk.00000.npz", "train/other.00000.npz"),
    ),
    (
        "a training scan twice, with another fit",
        WARNED,
        "1 train frames have the scan",
        lambda f, base: copied(
            "train/walk.00000.npz",
            "train/other.00000.npz",
            translation=base.frames[FRAME]["translation"] + np.float32([0.001, 0, 0]),
        )(f, base),
    ),
    (
        "one training frame alone",
        REFUSED,
        "validation_share: expected frames left to train on",
        without("train/walk.0000[12].npz"),
    ),
    ("a frame cut off", REFUSED, r"walk\.00000\.npz: expected a valid npz file", truncated(FRAME, 0.7)),
    ("a frame of no bytes", REFUSED, r"walk\.00000\.npz: expected a valid npz file", truncated(FRAME, 0)),
    ("a frame that is text", REFUSED, r"walk\.00000\.npz: expected a valid npz file", also(FRAME, b"1 2 3\n" * 99)),
    ("a frame with accents and a space in its name", READ, "", renamed(FRAME, "train/gehén 1.00000.npz")),
    (
        "a folder that ends in .npz",
        REFUSED,
        r"walk\.00009\.npz: expected an npz file",
        lambda f, base: (f / "train/walk.00009.npz").mkdir(),
    ),
    (
        "a frame of another body",
        REFUSED,
        r"body_verts: expected \d+ rows as in the template, got 100",
        lambda f, base: save(
            f / FRAME,
            lacking("vtransf")(base.frames[FRAME], base) | {"body_verts": base.frames[FRAME]["body_verts"][:100]},
        ),
    ),
    ("a template.obj for the body", READ, "", as_obj(lambda b: b)),
    ("a template.obj wound inward", REFUSED, "wound inward", as_obj(lambda b: b | {"faces": b["faces"][:, ::-1]})),
    ("a template.obj in inches", REFUSED, "inches", as_obj(lambda b: b | {"vertices": b["vertices"] / 0.0254})),
    ("a template.obj z up", REFUSED, "degrees about x", as_obj(lambda b: turned_body(turn("x", 90))(b, None))),
    ("no body", REFUSED, "expected template.npz or template.obj", without("template.npz")),
    ("a body cut off", REFUSED, r"template\.npz: expected a valid npz file", truncated("template.npz", 0.5)),
    (
        "outfit.yaml naming a body that is not there",
        REFUSED,
        "bodies/mine.npz",
        also("outfit.yaml", b"body:\n  path: ../bodies/mine.npz\n"),
    ),
    ("outfit.yaml with tabs", REFUSED, r"outfit\.yaml", also("outfit.yaml", b"body:\n\tpath: template.npz\n")),
    ("outfit.yaml that is a list", REFUSED, r"outfit\.yaml", also("outfit.yaml", b"- body\n")),
    (
        "outfit.yaml with a key of another name",
        REFUSED,
        r"outfit\.yaml: .*bdoy",
        also("outfit.yaml", b"bdoy:\n  path: template.npz\n"),
    ),
    (
        "outfit.yaml with betas for a body without shapes",
        REFUSED,
        "betas",
        also("outfit.yaml", b"body:\n  path: template.npz\n  betas: [1, 2]\n"),
    ),
    (
        "outfit.yaml of another format",
        REFUSED,
        "expected format outfit/1, got outfit/9",
        also("outfit.yaml", b"format: outfit/9\n"),
    ),
    (
        "every scan 0.95 times as large",
        WARNED,
        r"0\.95 times the body's size.*Others like it",
        all_frames(moved(0.95 * np.eye(3))),
    ),
    (
        "every frame the same",
        WARNED,
        "2 train frames have the scan of another",
        all_frames(
            lambda f, base: (
                f | {key: base.frames[FRAME][key] for key in ("pose", "body_verts", "vtransf", "translation", *ON)}
            )
        ),
    ),
]
