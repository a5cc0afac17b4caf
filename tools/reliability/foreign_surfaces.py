"""Scans as other programs write them: valid files of each kind that `read_surface` reads, made byte by byte."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from avatar.io.raw_surface import RawSurface
from avatar.records import PointCloud
from reliability.validators import validate_mesh, validate_points

SIDES = 20
ANGLES = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
RING = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
VERTICES = [(x, height, z) for height in (0.0, 1.7) for x, z in RING.tolist()]  # of a drum
QUADS = [(i, (i + 1) % SIDES, (i + 1) % SIDES + SIDES, i + SIDES) for i in range(SIDES)]
LID = tuple(range(SIDES))


def validate_surface(surface: RawSurface) -> str:
    """Surface: a valid mesh, or finite points; normals of unit length; colours in [0, 1]."""
    count = len(surface.vertices)
    normals = np.tile([0.0, 0.0, 1.0], (count, 1)) if surface.normals is None else surface.normals
    fault = validate_points(PointCloud(surface.vertices, normals, surface.colors))
    return fault or ("" if surface.faces is None else validate_mesh(surface.mesh))


def uneven_ply() -> bytes:
    """A big-endian PLY with a list before the vertices, long normals, colours, quads and a polygon."""
    header = "ply\nformat binary_big_endian 1.0\nelement camera 2\nproperty list uchar float view\n"
    header += f"element vertex {len(VERTICES)}\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    header += "".join(f"property double {name}\n" for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z"))
    header += f"element face {SIDES + 1}\nproperty uchar flag\nproperty list ushort uint vertex_index\nend_header\n"
    data = header.encode() + struct.pack(">B2fB3f", 2, 1, 2, 3, 1, 2, 3)
    data += b"".join(struct.pack(">3B6d", 9, 99, 199, *at, 2 * at[0], 0, 2 * at[2]) for at in VERTICES)
    return data + b"".join(struct.pack(f">BH{len(of)}I", 1, len(of), *of) for of in [*QUADS, LID])


def uneven_text_ply() -> bytes:
    """The same drum in text, without normals and colours."""
    header = f"ply\nformat ascii 1.0\nelement vertex {len(VERTICES)}\nproperty float x\nproperty float y\n"
    header += f"property float z\nelement face {SIDES + 1}\nproperty list uchar int vertex_index\nend_header\n"
    rows = [*VERTICES, *((len(of), *of) for of in [*QUADS, LID])]
    return (header + "".join(" ".join(map(str, row)) + "\n" for row in rows)).encode()


def coloured_obj() -> bytes:
    """An OBJ with colours, negative indices, texture coordinates, groups and a broken line."""
    text = "# a drum\nmtllib drum.mtl\n" + "".join(f"v {x} {y} {z} 0.1 0.5 1\n" for x, y, z in VERTICES)
    text += "vt 0 0\nvt 1 1\nvn 0 1 0\nusemtl side\n" + "".join(
        f"f {a + 1}/1 {b + 1}/2 {c + 1}/1 {d + 1}/2\n" for a, b, c, d in QUADS
    )
    return (text + "g lid\nf " + " ".join(f"{i - 2 * SIDES}//1" for i in LID[:9]) + " \\\n-31 -30 -29\n").encode()


def skinned_gltf() -> bytes:
    """A glTF with its data in itself: strips and triangles, a skin, nodes, normals, colours, sparse values."""
    data, views, accessors = b"", [], []

    def view(values: np.ndarray) -> int:
        nonlocal data
        data += b"\0" * (-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes})
        data += values.tobytes()
        return len(views) - 1

    def accessor(values: np.ndarray, code: int, kind: str, **more) -> int:
        accessors.append({"bufferView": view(values), "componentType": code, "type": kind, "count": len(values)} | more)
        return len(accessors) - 1

    count, ring = len(VERTICES), np.array(VERTICES, "<f4")
    strip = np.array([i % SIDES + part * SIDES for i in range(SIDES + 1) for part in (0, 1)], "<u2")
    attributes = {"POSITION": accessor(ring, 5126, "VEC3"), "NORMAL": accessor(ring + 1, 5126, "VEC3")}
    sparse = {"count": 1, "indices": {"bufferView": view(np.array([3], "<u2")), "componentType": 5123}}
    accessors[0]["sparse"] = sparse | {"values": {"bufferView": view(ring[3:4])}}
    attributes["COLOR_0"] = accessor(np.full((count, 4), 77, "u1"), 5121, "VEC4", normalized=True)
    attributes["JOINTS_0"] = accessor(np.zeros((count, 4), "u1"), 5121, "VEC4")
    attributes["WEIGHTS_0"] = accessor(np.full((count, 4), 0.25, "<f4"), 5126, "VEC4")
    primitives = [{"attributes": attributes, "indices": accessor(strip, 5123, "SCALAR"), "mode": 5}]
    lid = np.array([(0, i, i + 1) for i in range(1, SIDES - 1)], "u1").reshape(-1)
    primitives.append({"attributes": attributes, "indices": accessor(lid, 5121, "SCALAR")})
    bind = accessor(np.eye(4, dtype="<f4").reshape(1, 16), 5126, "MAT4")
    document = {"asset": {"version": "2.0"}, "meshes": [{"primitives": primitives}], "accessors": accessors}
    document |= {"bufferViews": views, "scene": 0, "scenes": [{"nodes": [0, 1]}]}
    document["nodes"] = [
        {"mesh": 0, "skin": 0},
        {"rotation": [0, 1, 0, 0], "children": [2]},
        {"mesh": 0, "scale": [2, 2, 2]},
    ]
    document["skins"] = [{"joints": [1], "inverseBindMatrices": bind}]
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return json.dumps(document | {"buffers": [{"byteLength": len(data), "uri": uri}]}).encode()


def pcd(kind: str) -> Callable[[], bytes]:
    """An oriented, coloured PCD of an encoding."""

    def make() -> bytes:
        names = "x y z normal_x normal_y normal_z rgb"
        header = f"VERSION 0.7\nFIELDS {names}\nSIZE 4 4 4 4 4 4 4\nTYPE F F F F F F U\nCOUNT 1 1 1 1 1 1 1\n"
        header += f"WIDTH {len(VERTICES)}\nHEIGHT 1\nPOINTS {len(VERTICES)}\nDATA {kind}\n"
        rows = [(*at, at[0], 0.5, at[2], 0x00336699) for at in VERTICES]
        if kind == "ascii":
            return (header + "".join(" ".join(map(str, row)) + "\n" for row in rows)).encode()
        if kind == "binary":
            return header.encode() + b"".join(struct.pack("<6fI", *row) for row in rows)
        columns = b"".join(
            np.array(column, "<u4" if i == 6 else "<f4").tobytes() for i, column in enumerate(zip(*rows))
        )
        packed = b"".join(
            bytes([len(columns[i : i + 32]) - 1]) + columns[i : i + 32] for i in range(0, len(columns), 32)
        )
        return header.encode() + struct.pack("<II", len(packed), len(columns)) + packed

    return make


MAKERS: dict[str, Callable[[], bytes]] = {
    "scan.ply": uneven_ply,
    "scan_text.ply": uneven_text_ply,
    "scan.obj": coloured_obj,
    "scan.gltf": skinned_gltf,
    "scan_text.pcd": pcd("ascii"),
    "scan.pcd": pcd("binary"),
    "scan_compressed.pcd": pcd("binary_compressed"),
}


def make_foreign(name: str) -> Callable[[Path], Path]:
    """What writes one of the files into a folder and returns its path."""

    def make(folder: Path) -> Path:
        (folder / name).write_bytes(MAKERS[name]())
        return folder / name

    return make
