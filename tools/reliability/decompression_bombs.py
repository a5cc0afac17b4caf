"""`bombs`: decompression bombs and headers that declare gigabytes; each must be refused before memory is allocated."""

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

from avatar.body.packed import packed_body
from avatar.body.smpl import convert_body_model
from avatar.checks import AvatarError, require
from avatar.io.bvh import read_bvh
from avatar.io.checkpoints import load_checkpoint, read_weights
from avatar.io.documents import read_json, read_yaml
from avatar.io.frames import read_open_frame
from avatar.io.meshes import read_mesh
from avatar.io.motions import read_motion
from avatar.io.npz import write_whole
from avatar.io.points import read_points
from avatar.io.surfaces import read_surface
from avatar.runs.training import load_avatar
from reliability.findings import Finding, all_of
from reliability.formats import BVH, smpl_arrays
from reliability.small_jobs import DECODER, folder_of, prepare, train_job
from reliability.workers import call_in_process, peak_memory, run_worker

MOST = 64  # MiB that a refusal may allocate
HUGE = 1 << 33
Bomb = Callable[[Path], Callable[[], Any]]
PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA {kind}\n"
PLY = "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
PLY += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
FACES = "element face {count}\nproperty list uchar int vertex_indices\n"


def bomb_file(name: str, data: bytes, read: Callable[[Path], Any]) -> Bomb:
    """A decompression bomb of fixed content."""

    def write(folder: Path) -> Callable[[], Any]:
        (folder / name).write_bytes(data)
        return lambda: read(folder / name)

    return write


def deflated(member: str, kind: str, shape: tuple[int, ...], megabytes: int) -> bytes:
    """An npz whose one member unpacks to so many mebibytes of zeros, under a header that declares a shape."""
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
    """A deflated checkpoint of zeros, named by its own hash."""
    plain, squeezed = io.BytesIO(), io.BytesIO()
    torch.save({"model": {"weight": torch.zeros(1 << 24)}, "step": 1, "score": None}, plain)
    with zipfile.ZipFile(plain) as source, zipfile.ZipFile(squeezed, "w") as target:
        for info in source.infolist():
            target.writestr(info.filename, source.read(info), zipfile.ZIP_DEFLATED, compresslevel=1)
    digest = hashlib.sha256(squeezed.getvalue()).hexdigest()
    (folder / f"step-00000001.{digest[:16]}.pt").write_bytes(squeezed.getvalue())
    return lambda: load_checkpoint(folder)


def weights_bomb(folder: Path) -> Callable[[], Any]:
    """A safetensors header that declares more bytes than its file has."""
    header = json.dumps({"a": {"dtype": "F32", "shape": [HUGE], "data_offsets": [0, 4 * HUGE]}}).encode()
    data = struct.pack("<Q", len(header)) + header + bytes(64)
    (folder / "avatar.safetensors").write_bytes(data)
    (folder / "avatar.json").write_text(json.dumps({"sha256": hashlib.sha256(data).hexdigest()}))
    return lambda: read_weights(folder / "avatar")


def network_bomb(**changes: Any) -> Bomb:
    """A run whose settings declare a network larger than any memory, with a few weights."""

    def write(folder: Path) -> Callable[[], Any]:
        run = folder_of("closet", folder.parents[1], "valid")
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
    """Decompression bombs by name."""
    count = 4_000_000_000
    accessor = {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}
    scene = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 64}]}
    scene |= {"bufferViews": [{"buffer": 0, "byteLength": 64}]}
    scene |= {"accessors": [accessor], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
    scene |= {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    crowd = scene | {"buffers": [{"byteLength": 12_000}], "bufferViews": [{"buffer": 0, "byteLength": 12_000}]}
    crowd |= {"accessors": [accessor | {"count": 1000}], "nodes": [{"mesh": 0}] * 10_000}
    crowd["scenes"] = [{"nodes": list(range(10_000))}]
    aliases = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefghi", "bcdefghij")
    )
    wide = {**DECODER, "width": 1 << 20}
    memo = b"\x80\x02r" + struct.pack("<I", 0xFFFFFFF0) + b"."
    long_bytes = b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"x."
    points, faces = PLY.format(count=count), FACES.format(count=count)
    return {
        "npz of 24 bytes that declares 3 GiB": bomb_file(
            "template.npz", deflated("vertices", "<f4", (1 << 28, 3), 0), packed_body
        ),
        "npz of zeros": bomb_file("motion.npz", deflated("trans", "<f4", (1 << 22, 3), 48), read_motion),
        "npz of zeros, a frame": bomb_file("f.npz", deflated("cloth_high", "|u1", (3, 24 << 20), 72), read_open_frame),
        "npz of many members": bomb_file("model.npz", npz_of_many_members(), convert),
        "pickle memo": bomb_file("model.pkl", memo, convert),
        "pickle length": bomb_file("model.pkl", long_bytes, convert),
        "pickle sparse matrix": bomb_file("model.pkl", sparse_model(), convert),
        "ply points": bomb_file("points.ply", f"{points}end_header\n".encode(), read_points),
        "ply mesh": bomb_file("mesh.ply", f"{points}{FACES.format(count=9)}end_header\n".encode(), read_mesh),
        "ply faces": bomb_file("mesh.ply", f"{PLY.format(count=3)}{faces}end_header\n".encode() + bytes(72), read_mesh),
        "off": bomb_file("mesh.off", f"OFF\n{count} {count} 0\n0 0 0\n".encode(), read_mesh),
        "stl": bomb_file("mesh.stl", bytes(80) + struct.pack("<I", count) + bytes(100), read_mesh),
        "glb accessor": bomb_file("mesh.glb", glb(scene, 64), read_mesh),
        "pcd": bomb_file("scan.pcd", PCD.format(count=count, kind="binary").encode() + bytes(64), read_surface),
        "pcd, compressed": bomb_file(
            "scan.pcd", PCD.format(count=1 << 22, kind="binary_compressed").encode() + bytes(64), read_surface
        ),
        "glb instances": bomb_file("mesh.glb", glb(crowd, 12_000), read_surface),
        "BVH frames": bomb_file("walk.bvh", BVH.replace("Frames: 3", "Frames: 1000000000").encode(), read_bvh),
        "yaml with exponential aliases": bomb_file("config.yaml", aliases.encode(), read_yaml),
        "yaml, deep": bomb_file("config.yaml", b"a: " + b"[" * 20_000, read_yaml),
        "json, deep": bomb_file("avatar.json", b"[" * 200_000, read_json),
        "checkpoint, deflated": deflated_checkpoint,
        "safetensors header": weights_bomb,
        "settings of a huge network": network_bomb(garment_decoder=wide),
    }


def npz_of_many_members() -> bytes:
    """An npz with twenty thousand members."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for number in range(20_000):
            archive.writestr(f"{number}.npy", b"")
    return packed.getvalue()


def sparse_model() -> bytes:
    """A body model's pickle whose sparse matrix declares a billion rows and columns."""
    regressor = csc_matrix((1, 1))
    regressor._shape = (10**9, 10**9)
    return pickle.dumps({**smpl_arrays(), "J_regressor": regressor})


def convert(path: Path) -> Any:
    """A body model through the converter."""
    return convert_body_model(path, path.with_name("converted.npz"))


def bomb_trial(root: Path) -> list[Finding]:
    """Reads every decompression bomb in a process of its own and measures the memory of its refusal."""
    call_in_process(prepare, root)
    call_in_process(train_job, "closet", root, "valid")
    folder, bombs = root / "bombs", corpus()
    shutil.rmtree(folder, ignore_errors=True)
    refused, most = 0, 0.0
    outcomes = {}
    for number, (name, write) in enumerate(bombs.items()):
        (folder / str(number)).mkdir(parents=True)
        outcome = run_worker(measure_refusal, write(folder / str(number)), timeout=60)
        outcomes[name] = vars(outcome)
        refused += outcome.value is not None and outcome.value["refused"]
        most = max(most, outcome.value["MiB"] if outcome.value else 1e6)
    write_whole(root / "bombs.json", json.dumps(outcomes, indent=1).encode())
    return [
        all_of("bombs", "refused with one typed error", refused, len(bombs)),
        Finding("bombs", "largest memory of a refusal", round(most, 1), "MiB", len(bombs), None, MOST),
    ]


def measure_refusal(load: Callable[[], Any]) -> dict[str, Any]:
    """Whether loading is refused, and the increase of this process's peak memory meanwhile."""
    require("trimesh")  # a library is no part of a refusal
    before, refused = peak_memory(), False
    try:
        load()
    except AvatarError:
        refused = True
    return {"refused": refused, "MiB": (peak_memory() - before) / 2**20}
