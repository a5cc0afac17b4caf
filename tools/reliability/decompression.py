"""`bombs`: small files that promise or unpack to gigabytes; each must be refused before the memory is taken."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as pack_tensors
from scipy.sparse import csc_matrix

from avatar.body.convert import convert_body_model
from avatar.body.packed import packed_body
from avatar.checks import AvatarError, require
from avatar.io.bvh import read_bvh
from avatar.io.documents import read_json, read_yaml
from avatar.io.frames import read_open_frame
from avatar.io.meshes import read_mesh
from avatar.io.motions import read_motion
from avatar.io.npz import write_whole
from avatar.io.points import read_points
from avatar.pipeline.methods import load_avatar
from avatar.training.checkpoints import load_checkpoint, read_weights
from reliability.findings import Finding, all_of
from reliability.formats import BVH, smpl_arrays
from reliability.small_jobs import DECODER, folder_of, prepare, train_job
from reliability.workers import peak_memory, run_victim, work_alone

MOST = 64  # MiB that a refusal may take
HUGE = 1 << 33
Bomb = Callable[[Path], Callable[[], Any]]
PLY = "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
PLY += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
FACES = "element face {count}\nproperty list uchar int vertex_indices\n"


def file_bomb(name: str, data: bytes, read: Callable[[Path], Any]) -> Bomb:
    """A file of fixed content."""

    def write(folder: Path) -> Callable[[], Any]:
        (folder / name).write_bytes(data)
        return lambda: read(folder / name)

    return write


def deflated(member: str, kind: str, shape: tuple[int, ...], megabytes: int) -> bytes:
    """An npz whose one member unpacks to so many mebibytes of zeros, under a header that promises a shape."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    packed = io.BytesIO()
    with (
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(f"{member}.npy", "w", force_zip64=True) as stream,
    ):
        stream.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        for _ in range(megabytes):
            stream.write(bytes(1 << 20))
    return packed.getvalue()


def deflated_checkpoint(folder: Path) -> Callable[[], Any]:
    """A checkpoint of zeros, deflated, under the name that its hash asks for."""
    plain, squeezed = io.BytesIO(), io.BytesIO()
    torch.save({"model": {"weight": torch.zeros(1 << 24)}, "step": 1, "score": None}, plain)
    with zipfile.ZipFile(plain) as source, zipfile.ZipFile(squeezed, "w") as target:
        for info in source.infolist():
            target.writestr(info.filename, source.read(info), zipfile.ZIP_DEFLATED, compresslevel=1)
    digest = hashlib.sha256(squeezed.getvalue()).hexdigest()
    (folder / f"step-00000001.{digest[:16]}.pt").write_bytes(squeezed.getvalue())
    return lambda: load_checkpoint(folder)


def weights_bomb(folder: Path) -> Callable[[], Any]:
    """A safetensors header that promises more than its file has."""
    header = json.dumps({"a": {"dtype": "F32", "shape": [HUGE], "data_offsets": [0, 4 * HUGE]}}).encode()
    data = struct.pack("<Q", len(header)) + header + bytes(64)
    (folder / "avatar.safetensors").write_bytes(data)
    (folder / "avatar.json").write_text(json.dumps({"sha256": hashlib.sha256(data).hexdigest()}))
    return lambda: read_weights(folder / "avatar")


def network_bomb(**changes: Any) -> Bomb:
    """A run whose settings ask for a network that no machine holds, beside a handful of weights."""

    def write(folder: Path) -> Callable[[], Any]:
        run = folder_of("closet", folder.parents[1], "sound")
        for name in ("template.npz", "config.yaml"):
            shutil.copyfile(run / name, folder / name)
        description = json.loads((run / "avatar.json").read_text())
        description["config"]["method"]["settings"] |= changes
        data = pack_tensors({"codes": torch.zeros(3)})
        (folder / "avatar.safetensors").write_bytes(data)
        (folder / "avatar.json").write_text(json.dumps(description | {"sha256": hashlib.sha256(data).hexdigest()}))
        return lambda: load_avatar(folder, device="cpu")

    return write


def glb(document: dict[str, Any], binary: int) -> bytes:
    """A GLB of one JSON chunk and a binary chunk of so many zeros."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I", len(text)) + b"JSON" + text + struct.pack("<I", binary) + b"BIN\0" + bytes(binary)
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def corpus() -> dict[str, Bomb]:
    """All bombs by name."""
    count = 4_000_000_000
    accessor = {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}
    scene = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 64}]}
    scene |= {"bufferViews": [{"buffer": 0, "byteLength": 64}]}
    scene |= {"accessors": [accessor], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
    scene |= {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    lazy = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefghi", "bcdefghij")
    )
    wide = {**DECODER, "width": 1 << 20}
    memo = b"\x80\x02r" + struct.pack("<I", 0xFFFFFFF0) + b"."
    long_bytes = b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"x."
    points, faces = PLY.format(count=count), FACES.format(count=count)
    return {
        "npz of 24 bytes that promises 3 GiB": file_bomb(
            "template.npz", deflated("vertices", "<f4", (1 << 28, 3), 0), packed_body
        ),
        "npz of zeros": file_bomb("motion.npz", deflated("trans", "<f4", (1 << 22, 3), 48), read_motion),
        "npz of zeros, a frame": file_bomb("f.npz", deflated("cloth_high", "|u1", (3, 24 << 20), 72), read_open_frame),
        "npz of many members": file_bomb("model.npz", crowded_npz(), convert_and_drop),
        "pickle memo": file_bomb("model.pkl", memo, convert_and_drop),
        "pickle length": file_bomb("model.pkl", long_bytes, convert_and_drop),
        "pickle sparse matrix": file_bomb("model.pkl", sparse_model(), convert_and_drop),
        "ply points": file_bomb("points.ply", f"{points}end_header\n".encode(), read_points),
        "ply mesh": file_bomb("mesh.ply", f"{points}{FACES.format(count=9)}end_header\n".encode(), read_mesh),
        "ply faces": file_bomb("mesh.ply", f"{PLY.format(count=3)}{faces}end_header\n".encode() + bytes(72), read_mesh),
        "off": file_bomb("mesh.off", f"OFF\n{count} {count} 0\n0 0 0\n".encode(), read_mesh),
        "stl": file_bomb("mesh.stl", bytes(80) + struct.pack("<I", count) + bytes(100), read_mesh),
        "glb accessor": file_bomb("mesh.glb", glb(scene, 64), read_mesh),
        "BVH frames": file_bomb("walk.bvh", BVH.replace("Frames: 3", "Frames: 1000000000").encode(), read_bvh),
        "yaml of a billion laughs": file_bomb("config.yaml", lazy.encode(), read_yaml),
        "yaml, deep": file_bomb("config.yaml", b"a: " + b"[" * 20_000, read_yaml),
        "json, deep": file_bomb("avatar.json", b"[" * 200_000, read_json),
        "checkpoint, deflated": deflated_checkpoint,
        "safetensors header": weights_bomb,
        "settings of a huge network": network_bomb(garment_decoder=wide),
    }


def crowded_npz() -> bytes:
    """An npz with a hundred thousand members."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for number in range(20_000):
            archive.writestr(f"{number}.npy", b"")
    return packed.getvalue()


def sparse_model() -> bytes:
    """A body model's pickle whose sparse matrix says that it has a billion rows and columns."""
    regressor = csc_matrix((1, 1))
    regressor._shape = (10**9, 10**9)
    return pickle.dumps({**smpl_arrays(), "J_regressor": regressor})


def convert_and_drop(path: Path) -> Any:
    """A body model through the converter."""
    return convert_body_model(path, path.with_name("converted.npz"))


def bomb_trial(root: Path) -> list[Finding]:
    """Reads every bomb in a process of its own and looks at what its refusal took."""
    work_alone(prepare, root)
    work_alone(train_job, "closet", root, "sound")
    folder, bombs = root / "bombs", corpus()
    shutil.rmtree(folder, ignore_errors=True)
    refused, most = 0, 0.0
    told = {}
    for number, (name, write) in enumerate(bombs.items()):
        (folder / str(number)).mkdir(parents=True)
        outcome = run_victim(measure_refusal, write(folder / str(number)), timeout=60)
        told[name] = vars(outcome)
        refused += outcome.value is not None and outcome.value["refused"]
        most = max(most, outcome.value["MiB"] if outcome.value else 1e6)
    write_whole(root / "bombs.json", json.dumps(told, indent=1).encode())
    return [
        all_of("bombs", "refused by one typed error", refused, len(bombs)),
        Finding("bombs", "memory that a refusal took, at most", round(most, 1), "MiB", len(bombs), None, MOST),
    ]


def measure_refusal(load: Callable[[], Any]) -> dict[str, Any]:
    """Whether loading is refused, and by how much the peak of this process's memory rose meanwhile."""
    require("trimesh")  # a library is no part of a refusal
    before, refused = peak_memory(), False
    try:
        load()
    except AvatarError:
        refused = True
    return {"refused": refused, "MiB": (peak_memory() - before) / 2**20}
