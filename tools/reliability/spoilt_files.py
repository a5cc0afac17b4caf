"""Faults of motions and meshes: functions of AMASS's arrays, and bytes of mesh files."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reliability.spoilt import READ, REFUSED, WARNED, Arrays, Base, put, swapped, turn


def motion_pose(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """The poses ``(T, 52, 3)`` changed."""

    def spoil(motion: Arrays, base: Base) -> Arrays:
        poses = change(motion["poses"].reshape(len(motion["poses"]), 52, 3))
        return motion | {"poses": poses.reshape(len(poses), -1)}

    return spoil


def exchanged(poses: np.ndarray) -> np.ndarray:
    """Poses whose left and right joints are exchanged."""
    return poses[:, swapped() + list(range(22, 52))]


def with_jump(poses: np.ndarray) -> np.ndarray:
    """Poses of which one is another."""
    poses[30, 1:22] = np.random.default_rng(0).normal(size=(21, 3))
    return poses


MOTIONS = [
    ("as it is", READ, "", lambda motion, base: motion),
    ("y up", REFUSED, "upright along y .*up=y", lambda m, base: m | rotated_motion(m, turn("x", -90))),
    ("upside down", REFUSED, "upright along -z .*up=-z", lambda m, base: m | rotated_motion(m, turn("x", 180))),
    ("in degrees", REFUSED, "degrees", lambda m, base: m | {"poses": np.degrees(m["poses"])}),
    (
        "as matrices",
        REFUSED,
        "These are rotation matrices of 52 joints",
        lambda m, base: (
            m | {"poses": Rotation.from_rotvec(m["poses"].reshape(-1, 3)).as_matrix().reshape(len(m["poses"]), -1)}
        ),
    ),
    (
        "as quaternions",
        REFUSED,
        "These are quaternions",
        lambda m, base: (
            m | {"poses": Rotation.from_rotvec(m["poses"].reshape(-1, 3)).as_quat().reshape(len(m["poses"]), -1)}
        ),
    ),
    ("translations in centimetres", REFUSED, "units=cm", lambda m, base: m | {"trans": 100 * m["trans"]}),
    ("translations in millimetres", REFUSED, "units=mm", lambda m, base: m | {"trans": 1000 * m["trans"]}),
    ("translations of another length", REFUSED, "trans", lambda m, base: m | {"trans": m["trans"][:-1]}),
    (
        "translations y up, poses z up",
        WARNED,
        "turned up without the poses",
        lambda m, base: m | {"trans": m["trans"] @ turn("x", -90).T},
    ),
    (
        "translations in feet",
        WARNED,
        "feet slide: .*multiplied by 0.3",
        lambda m, base: m | {"trans": m["trans"] / 0.3048},
    ),
    ("translations in inches", REFUSED, "units=in", lambda m, base: m | {"trans": m["trans"] / 0.0254}),
    ("frames in another order", WARNED, "are frames in their order", motion_pose(np.random.default_rng(0).permutation)),
    ("a frame of another motion", WARNED, "jump by up to .* after frame 29", motion_pose(with_jump)),
    ("left and right exchanged", WARNED, "left", motion_pose(exchanged)),
    (
        "joints in another order",
        WARNED,
        "joints in SMPL's order",
        motion_pose(lambda p: np.concatenate([p[:, :1], p[:, 1:22][:, ::-1], p[:, 22:]], axis=1)),
    ),
    ("poses negated", WARNED, "bends backwards", motion_pose(lambda p: np.concatenate([p[:, :1], -p[:, 1:]], axis=1))),
    ("a NaN", REFUSED, "poses: expected finite", put("poses", (3, 3), np.nan)),
    (
        "no frame rate",
        REFUSED,
        "expected mocap_framerate .*Give fps=",
        lambda m, base: {k: v for k, v in m.items() if k != "mocap_framerate"},
    ),
    ("a frame rate of 0", REFUSED, "frames per second, got 0", lambda m, base: m | {"mocap_framerate": np.array(0.0)}),
    ("a frame rate as text", READ, "", lambda m, base: m | {"mocap_framerate": np.array("30")}),
    (
        "no frames",
        REFUSED,
        "at least one frame",
        lambda m, base: m | {"poses": m["poses"][:0], "trans": m["trans"][:0]},
    ),
    ("one frame", READ, "", lambda m, base: m | {"poses": m["poses"][:1], "trans": m["trans"][:1]}),
    ("one frame, flat", READ, "", lambda m, base: m | {"poses": m["poses"][0], "trans": m["trans"][0]}),
    ("poses (T, 52, 3)", READ, "", lambda m, base: m | {"poses": m["poses"].reshape(-1, 52, 3)}),
    ("poses of 23 joints", WARNED, "joints", lambda m, base: m | {"poses": m["poses"][:, : 23 * 3]}),
    ("poses transposed", REFUSED, "poses", lambda m, base: m | {"poses": m["poses"].T}),
    (
        "big-endian, in Fortran order",
        READ,
        "",
        lambda m, base: m | {"poses": np.asfortranarray(m["poses"].astype(">f4"))},
    ),
    ("as half floats", READ, "", lambda m, base: m | {"poses": m["poses"].astype(np.float16)}),
    ("as Python objects", REFUSED, "Python objects", lambda m, base: m | {"poses": m["poses"].astype(object)}),
    ("no poses", REFUSED, "poses", lambda m, base: {k: v for k, v in m.items() if k != "poses"}),
    (
        "translations of 1e6 m",
        REFUSED,
        "m/s|metres",
        lambda m, base: m | {"trans": m["trans"] + np.linspace(0, 1e6, len(m["trans"]))[:, None]},
    ),
]


def rotated_motion(motion: Arrays, linear: np.ndarray) -> Arrays:
    """The motion in a turned world."""
    poses = motion["poses"].copy()
    poses[:, :3] = (Rotation.from_matrix(linear) * Rotation.from_rotvec(poses[:, :3])).as_rotvec()
    return {"poses": poses, "trans": motion["trans"] @ np.transpose(linear)}


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
    (
        "an OBJ without faces",
        REFUSED,
        r"expected triangles, got a point cloud of \d+ points|normals",
        ".obj",
        lambda s: obj(Shape(s.vertices, s.faces[:0], s.normals)),
    ),
    ("an OBJ with indices from 0", REFUSED, "points to vertex 0 of", ".obj", lambda s: obj(s, 0)),
    ("an OBJ with a decimal comma", REFUSED, "obj", ".obj", lambda s: obj(s).replace(b".", b",")),
    ("an OBJ in UTF-16", REFUSED, "UTF-16", ".obj", lambda s: obj(s).decode().encode("utf-16")),
    ("an OBJ with a NaN vertex", REFUSED, "finite", ".obj", lambda s: obj(with_vertex(s, np.nan))),
    ("an OBJ cut off", READ, "", ".obj", lambda s: obj(s)[: len(obj(s)) // 2 * 2 - 9]),
    ("a PLY as it is", READ, "", ".ply", ply),
    (
        "a PLY of points, given as a mesh",
        REFUSED,
        r"expected triangles, got a point cloud of \d+ points.*reconstruct",
        ".ply",
        lambda s: ply(s, faces=False),
    ),
    (
        "a PLY of points without normals",
        REFUSED,
        r"expected triangles, got a point cloud",
        ".ply",
        lambda s: ply(s, faces=False, normals=False),
    ),
    ("a PLY cut off", REFUSED, "ply", ".ply", lambda s: ply(s)[:-400]),
    ("a PLY that declares more vertices", REFUSED, "ply", ".ply", lambda s: ply(s, count=10**9)),
    ("a PLY with an infinite vertex", REFUSED, "finite", ".ply", lambda s: ply(with_vertex(s, np.inf))),
    (
        "a PLY with indices out of range",
        REFUSED,
        "indices",
        ".ply",
        lambda s: ply(Shape(s.vertices, s.faces + 9, s.normals)),
    ),
    ("a PLY with normals of no length", READ, "", ".ply", lambda s: ply(Shape(s.vertices, s.faces, 0 * s.normals))),
    (
        "a PLY of triangles without area",
        REFUSED,
        "triangles with area",
        ".ply",
        lambda s: ply(Shape(0 * s.vertices, s.faces, s.normals)),
    ),
    ("a GLB as it is", READ, "", ".glb", glb),
    (
        "a GLB with Draco's compression",
        REFUSED,
        "raco.*gltf-transform",
        ".glb",
        lambda s: glb(s, **json.loads(json.dumps(DRACO))),
    ),
    (
        "a GLB with quantised positions",
        REFUSED,
        "quanti.*gltf-transform",
        ".glb",
        lambda s: glb(s, kind=5122, **QUANTISED),
    ),
    ("a GLB without its buffer", REFUSED, "glb", ".glb", lambda s: glb(s)[:-400]),
    ("an STL as it is", READ, "", ".stl", stl),
    (
        "an STL of no triangles",
        REFUSED,
        "no vertices|triangles",
        ".stl",
        lambda s: stl(Shape(s.vertices, s.faces[:0], s.normals)),
    ),
    ("an STL cut off", REFUSED, "stl", ".stl", lambda s: stl(s)[:-77]),
    ("an FBX", REFUSED, "ending in", ".fbx", obj),
    ("an empty file", REFUSED, "at least 1 bytes, got 0", ".ply", lambda s: b""),
    ("a picture named .obj", REFUSED, "obj", ".obj", lambda s: b"\x89PNG\r\n\x1a\n" + bytes(300)),
]
