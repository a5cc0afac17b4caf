"""Rigged glTF files written by hand, as other programs export them."""

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from avatar.body.model import BodyModel
from avatar.body.open import MIXAMO_NAMES


@dataclass
class HandRig:
    """A skinned mesh of split vertices, bound where its joints are stored, below one node with a matrix."""

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    joints: np.ndarray
    parents: list[int]
    names: list[str]
    uv: np.ndarray
    armature: np.ndarray = field(default_factory=lambda: np.eye(4))
    joint_scale: float = 1.0  # of the left elbow
    skinned: bool = True


def mixamo_rig(body: BodyModel, finger: str = "mixamorig:LeftHandIndex1") -> HandRig:
    """The open body in its A-pose with Mixamo's names, vertices split at texture seams, and a finger joint."""
    owners = np.zeros(len(body.uv), int)
    owners[body.uv_faces.numpy().ravel()] = body.faces.numpy().ravel()
    weights = body.weights.numpy()[owners].astype(np.float64)
    hand = MIXAMO_NAMES.index("LeftHand")
    weights = np.concatenate([weights, weights[:, hand : hand + 1] / 4], axis=1)
    weights[:, hand] *= 0.75
    joints = body.bind_joints.numpy().astype(np.float64)
    return HandRig(
        vertices=body.bind_vertices.numpy()[owners].astype(np.float64),
        faces=body.uv_faces.numpy(),
        weights=weights,
        joints=np.concatenate([joints, joints[hand : hand + 1] + [0.1, 0, 0]]),
        parents=[*body.parents, hand],
        names=[*(f"mixamorig:{name}" for name in MIXAMO_NAMES), finger],
        uv=body.uv.numpy(),
    )


def write_rig(path: Path, rig: HandRig) -> Path:
    """Writes a GLB from the specification alone; the mesh's own space is that below the armature."""
    ids = np.argsort(-rig.weights, axis=1, kind="stable")[:, :8]
    values = np.take_along_axis(rig.weights, ids, axis=1).astype(np.float32)
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(rig.joints), 1, 1))
    inverse[:, :3, 3] = -rig.joints
    arrays = [
        (rig.vertices.astype("<f4"), "VEC3", 5126),
        (ids[:, :4].astype("u1"), "VEC4", 5121),
        (values[:, :4], "VEC4", 5126),
        (ids[:, 4:].astype("u1"), "VEC4", 5121),
        (values[:, 4:], "VEC4", 5126),
        ((rig.uv * [1, -1] + [0, 1]).astype("<f4"), "VEC2", 5126),
        (rig.faces.astype("<u4").reshape(-1), "SCALAR", 5125),
        (inverse.transpose(0, 2, 1), "MAT4", 5126),
    ]
    data, views, accessors = b"", [], []
    for array, kind, component in arrays:
        raw = np.ascontiguousarray(array).tobytes()
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(raw)})
        accessors.append({"bufferView": len(views) - 1, "count": len(array), "type": kind, "componentType": component})
        data += raw + b"\0" * (-len(raw) % 4)
    keys = ("POSITION", "JOINTS_0", "WEIGHTS_0", "JOINTS_1", "WEIGHTS_1", "TEXCOORD_0")
    nodes = []
    for joint, parent in enumerate(rig.parents):
        offset = rig.joints[joint] - (rig.joints[parent] if parent >= 0 else 0)
        node = {"name": rig.names[joint], "translation": offset.tolist()}
        children = [child for child, above in enumerate(rig.parents) if above == joint]
        nodes.append(node | ({"children": children} if children else {}))
    nodes[18]["scale"] = [rig.joint_scale] * 3
    mesh = {"mesh": 0} | ({"skin": 0} if rig.skinned else {})
    nodes += [{"matrix": rig.armature.T.ravel().tolist(), "children": [0, len(nodes) + 1]}, mesh]
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": {key: place for place, key in enumerate(keys)}, "indices": 6}]}],
        "nodes": nodes,
        "skins": [{"joints": list(range(len(rig.joints))), "inverseBindMatrices": 7}],
        "scenes": [{"nodes": [len(nodes) - 2]}],
        "scene": 0,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    whole = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    whole += struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(whole)
    return path
