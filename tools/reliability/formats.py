"""File formats that are read: for each a valid file, the reader, and an independent validator of what was read."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from avatar.body.packed import packed_body
from avatar.body.smpl import convert_body_model, joint_tree, smpl_body
from avatar.io.bvh import read_bvh
from avatar.io.checkpoints import load_checkpoint, read_weights, save_checkpoint, write_weights
from avatar.io.documents import read_yaml
from avatar.io.frames import read_canonical_scan, read_open_frame, read_open_garment, write_canonical_scan
from avatar.io.meshes import read_mesh, write_mesh
from avatar.io.motions import read_motion, write_motion
from avatar.io.points import read_points, write_points
from avatar.io.surfaces import read_surface
from avatar.methods.settings import RunConfig
from avatar.records import CanonicalScan, Mesh, Motion, PointCloud
from avatar.settings import settings_from_dict, settings_to_dict
from reliability.foreign_surfaces import MAKERS, make_foreign, validate_surface
from reliability.mutations import NUMBERS, mutate_array
from reliability.small_jobs import run_config
from reliability.validators import (
    validate_body,
    validate_bvh,
    validate_config,
    validate_frame,
    validate_garment,
    validate_mesh,
    validate_motion,
    validate_points,
    validate_scan,
    validate_state,
    validate_weights,
)

SCORE = 0.5  # validation score of the checkpoints
SHARED = {"weight": torch.arange(64.0)}  # exported weights


@dataclass(frozen=True)
class Format:
    """A file format.

    ``make(folder)`` writes valid files and returns the one to mutate; ``read(path)`` reads it; ``validate(value)``
    returns what is invalid about the value read, or nothing; ``mutate_values(data, rng)`` mutates values inside the
    container.
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], Any]
    validate: Callable[[Any], str]
    mutate_values: Callable[[bytes, random.Random], bytes] | None = None


def ball(count: int = 40) -> Mesh:
    """A small closed mesh."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = np.stack([np.cos(angles), np.zeros(count), np.sin(angles)], axis=1)
    vertices = np.concatenate([ring, [[0, 1, 0], [0, -1, 0]]])
    around = np.arange(count)
    caps = [np.stack([around, (around + 1) % count, np.full(count, count + end)], axis=1) for end in (0, 1)]
    return Mesh(vertices, np.concatenate(caps), np.abs(vertices).clip(0, 1))


def cloud() -> PointCloud:
    """Oriented, coloured points."""
    normals = np.random.default_rng(0).normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(normals * 0.9, normals, np.abs(normals).clip(0, 1))


def mesh_format(suffix: str) -> Format:
    """Meshes of one file name ending."""

    def make(folder: Path) -> Path:
        write_mesh(folder / f"mesh{suffix}", ball())
        return folder / f"mesh{suffix}"

    return Format(make, read_mesh, validate_mesh)


def make_ascii_mesh(folder: Path) -> Path:
    """A PLY mesh in text."""
    mesh, path = ball(), folder / "text.ply"
    header = f"ply\nformat ascii 1.0\nelement vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\n"
    header += f"property float z\nelement face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(str, row)) for row in mesh.vertices] + [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    path.write_text(header + "\n".join(rows) + "\n")
    return path


def make_ascii_points(folder: Path) -> Path:
    """A PLY of points in text."""
    points, path = cloud(), folder / "points_text.ply"
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points.points)}\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")) + "end_header\n"
    rows = np.concatenate([points.points, points.normals], axis=1)
    path.write_text(header + "\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    return path


def make_points(folder: Path) -> Path:
    """A binary PLY of points."""
    write_points(folder / "points.ply", cloud())
    return folder / "points.ply"


def smpl_arrays() -> dict[str, np.ndarray]:
    """A body model of SMPL's form with sixty vertices."""
    rng, parents = np.random.default_rng(0), joint_tree("smpl")[1]
    weights = rng.random((60, 24))
    return {
        "v_template": rng.normal(size=(60, 3)),
        "shapedirs": rng.normal(size=(60, 3, 10)),
        "J_regressor": rng.random((24, 60)) / 30,
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "f": rng.integers(0, 60, (80, 3)).astype(np.uint32),
        "kintree_table": np.array([parents, range(24)]).astype(np.uint32),
        "posedirs": rng.normal(size=(60, 3, 207)) * 1e-3,
    }


def make_model(suffix: str) -> Callable[[Path], Path]:
    """Writes a body model as pkl or npz."""

    def make(folder: Path) -> Path:
        path = folder / f"model{suffix}"
        if suffix == ".pkl":
            path.write_bytes(pickle.dumps(smpl_arrays(), protocol=2))
        else:
            np.savez(path, **smpl_arrays())
        return path

    return make


def convert(path: Path) -> Any:
    """A body model through the converter and back."""
    convert_body_model(path, path.with_name("converted.npz"))
    return smpl_body(path.with_name("converted.npz"))


def mutate_pickle(data: bytes, rng: random.Random) -> bytes:
    """Pickle of the same model, one of its arrays mutated."""
    arrays: dict[str, Any] = smpl_arrays()
    key = rng.choice(list(arrays))
    arrays[key] = mutate_array(arrays[key], rng)
    return pickle.dumps(arrays, protocol=rng.choice((0, 2, 4, 5)))


def mutate_arrays(data: bytes, rng: random.Random) -> bytes:
    """Npz with one of its arrays mutated and valid checksums."""
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        arrays = dict(stored)
    key = rng.choice(list(arrays))
    arrays[key] = mutate_array(arrays[key], rng)
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    return packed.getvalue()


def copied(*parts: str) -> Callable[[Path], Path]:
    """Makes a copy of a file of the embedded sample, or of the program's assets."""

    def make(folder: Path) -> Path:
        from avatar.data.folders import SAMPLE_FOLDER

        source = SAMPLE_FOLDER.joinpath(*parts)
        source = sorted(source.glob("*.npz"))[0] if source.is_dir() else source
        shutil.copyfile(source, folder / source.name)
        return folder / source.name

    return make


def make_template(folder: Path) -> Path:
    """A small body: two bones with sixty vertices."""
    rng = np.random.default_rng(0)
    weights = rng.random((60, 2)).astype(np.float32)
    np.savez(
        folder / "template.npz",
        vertices=rng.normal(size=(60, 3)).astype(np.float32),
        faces=rng.integers(0, 60, (80, 3)).astype(np.int32),
        weights=weights / weights.sum(axis=1, keepdims=True),
        parents=np.array([-1, 0], np.int32),
        joint_names=np.array(["root", "tip"]),
        joints=rng.normal(size=(2, 3)).astype(np.float32),
    )
    return folder / "template.npz"


def make_motion(folder: Path) -> Path:
    """A motion of five frames."""
    poses = np.random.default_rng(0).normal(size=(5, 22, 3)) * 0.3
    write_motion(folder / "motion.npz", Motion(poses, np.zeros((5, 3)), 30.0, "walk"))
    return folder / "motion.npz"


def make_amass(folder: Path) -> Path:
    """A motion as AMASS has it."""
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(5, 156)) * 0.2
    poses[:, 0] += np.pi / 2  # upright along z
    np.savez(folder / "amass.npz", poses=poses, trans=np.zeros((5, 3)), mocap_framerate=60.0)
    return folder / "amass.npz"


def make_canonical_scan(folder: Path) -> Path:
    """A canonical scan that is a mesh."""
    mesh, weights = ball(), np.random.default_rng(0).random((42, 3))
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    weights /= weights.sum(axis=1, keepdims=True)
    scan = CanonicalScan(mesh.vertices, normals, weights, np.arange(42), mesh.faces, mesh.colors)
    write_canonical_scan(folder / "scan.npz", scan)
    return folder / "scan.npz"


BVH = """HIERARCHY
ROOT Hips
{
 OFFSET 0 90 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
 JOINT Spine
 {
  OFFSET 0 20 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  End Site
  {
   OFFSET 0 10 0
  }
 }
}
MOTION
Frames: 3
Frame Time: 0.033333
0 90 0 1 2 3 4 5 6
1 91 2 10 20 30 40 50 60
2 92 4 -10 -20 -30 0 5 10
"""


def make_bvh(folder: Path) -> Path:
    """A BVH file of two joints and three frames."""
    (folder / "walk.bvh").write_text(BVH)
    return folder / "walk.bvh"


def states() -> list[dict[str, Any]]:
    """Two small states to save, with all that a trainer's has."""

    def state(step: int) -> dict[str, Any]:
        moments = {"exp_avg": torch.full((64,), 0.1 * step), "step": torch.tensor(float(step))}
        groups = [{"lr": 0.01 / step, "params": [0]}]
        random = [{"cpu": torch.Generator().manual_seed(step).get_state()}]
        model = {"weight": torch.full((64,), float(step)), "bias": torch.arange(4.0) * step}
        return {
            "model": model,
            "optimiser": {"state": {0: moments}, "param_groups": groups},
            "step": step,
            "random": random,
        }

    return [state(step) for step in (1, 2)]


def validate_checkpoint(state: Any) -> str:
    """Validation of a loaded state against the two that were saved."""
    return validate_state(state, [{**saved, "score": SCORE} for saved in states()])


def make_checkpoint(folder: Path) -> Path:
    """Two checkpoints; returns the newer."""
    return [save_checkpoint(folder / "checkpoints", state, state["step"], SCORE) for state in states()][-1]


def read_checkpoint(path: Path) -> Any:
    """State that a checkpoint's folder loads."""
    return load_checkpoint(path.parent)


def mutate_checkpoint(data: bytes, rng: random.Random) -> bytes:
    """Checkpoint of other content and step, packed by torch; `replace_content` names it by its hash."""
    state: Any = {**states()[1], "step": rng.choice((3, -1, None, "2", 1e30)), "score": SCORE}
    mutated = rng.choice((state["model"]["weight"], state["optimiser"]["state"][0]["exp_avg"]))
    mutated[rng.randrange(64)] = rng.choice((float("nan"), float("inf"), 3.0))
    state = rng.choice((state, [state], {"model": 3}, {}, {**state, "score": "low"}))
    packed = io.BytesIO()
    torch.save(state, packed)
    return packed.getvalue()


def make_weights(folder: Path) -> Path:
    """Exported weights, with their description."""
    write_weights(folder / "avatar", SHARED, {"steps": 3})
    return folder / "avatar.safetensors"


def read_shared(path: Path) -> Any:
    """Exported weights, as loading a run reads them."""
    return read_weights(path.with_suffix(""))


def mutate_weights(data: bytes, rng: random.Random) -> bytes:
    """Weights with a NaN or infinity; `replace_content` describes them with their hash."""
    mutated = bytearray(data)
    place = len(mutated) - 4 * rng.randint(1, 60)
    mutated[place : place + 4] = rng.choice((b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"\xff\xff\xff\xff"))
    return bytes(mutated)


def make_config(folder: Path) -> Path:
    """A run's settings."""
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(settings_to_dict(run_config("closet", Path("root"))), sort_keys=False))
    return path


def read_config(path: Path) -> Any:
    """Settings of a run, as `save_settings` and `load_avatar` take them."""
    return settings_from_dict(RunConfig, read_yaml(path), f"{path}: ")


def mutate_config(data: bytes, rng: random.Random) -> bytes:
    """Settings with one value of another kind or out of range."""
    values = yaml.safe_load(data)
    at = values
    while True:
        key = rng.choice(list(at))
        if not isinstance(at[key], dict) or not at[key] or rng.random() < 0.1:
            break
        at = at[key]
    wrong: list[Any] = ["../../etc", "/etc/passwd", "x" * 300, [], {}, [[[]]], None, True, -1, 0, 10**40]
    wrong += [float("nan"), float("inf"), {"_target_": "os.system", "_args_": ["id"]}]
    at[key] = rng.choice([*wrong, *(number.decode() for number in NUMBERS)])
    return yaml.safe_dump(values, sort_keys=False).encode()


def replace_content(path: Path, data: bytes) -> Path:
    """Writes mutated data in place of a file, with the hash that matches them; returns their path."""
    digest = hashlib.sha256(data).hexdigest()
    if path.suffix == ".pt":
        for old in path.parent.iterdir():
            old.unlink()
        path = path.with_name(f"step-00000002.{digest[:16]}.pt")
    elif path.suffix == ".safetensors":
        path.with_suffix(".json").write_text(json.dumps({"sha256": digest}))
    path.write_bytes(data)
    return path


FORMATS = {
    "ply points": Format(make_points, read_points, validate_points),
    "ply points, text": Format(make_ascii_points, read_points, validate_points),
    "ply mesh": mesh_format(".ply"),
    "ply mesh, text": Format(make_ascii_mesh, read_mesh, validate_mesh),
    "obj": mesh_format(".obj"),
    "glb": mesh_format(".glb"),
    "stl": mesh_format(".stl"),
    "off": mesh_format(".off"),
    **{name: Format(make_foreign(name), read_surface, validate_surface) for name in MAKERS},
    "body npz": Format(make_template, packed_body, validate_body, mutate_arrays),
    "frame npz": Format(copied("tee", "train"), read_open_frame, validate_frame, mutate_arrays),
    "garment npz": Format(copied("tee", "garment.npz"), read_open_garment, validate_garment, mutate_arrays),
    "motion npz": Format(make_motion, read_motion, validate_motion, mutate_arrays),
    "AMASS npz": Format(make_amass, read_motion, validate_motion, mutate_arrays),
    "canonical scan npz": Format(make_canonical_scan, read_canonical_scan, validate_scan, mutate_arrays),
    "SMPL pkl": Format(make_model(".pkl"), convert, validate_body, mutate_pickle),
    "SMPL npz": Format(make_model(".npz"), convert, validate_body, mutate_arrays),
    "BVH": Format(make_bvh, read_bvh, validate_bvh),
    "checkpoint": Format(make_checkpoint, read_checkpoint, validate_checkpoint, mutate_checkpoint),
    "safetensors": Format(make_weights, read_shared, lambda read: validate_weights(read, SHARED), mutate_weights),
    "config yaml": Format(make_config, read_config, validate_config, mutate_config),
}
