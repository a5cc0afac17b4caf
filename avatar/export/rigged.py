"""The body as a rigged, animated glTF: mesh, skeleton and motion, for any program that plays characters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.body.model import BodyModel
from avatar.checks import AvatarError, check_finite, check_shape, check_suffix, require
from avatar.geometry.surface import vertex_normals
from avatar.io.npz import write_whole
from avatar.records import Motion

ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
INFLUENCES = 4  # in one set of glTF attributes; some viewers read the first set only
MAX_SETS = 2
CLAY = [0.60, 0.51, 0.42, 1.0]  # linear RGB


def write_rigged_glb(path: str | Path, body: BodyModel, motion: Motion | None = None) -> None:
    """Writes a body with its skeleton, at rest in the T-pose, and a motion if given.

    Skinned from the bind pose as `BodyModel` does, so a viewer shows the vertices `BodyModel` computes; pose
    blendshapes, where a body has them, are left out. The eight largest skinning weights of a vertex are kept, in
    two sets of four where any vertex has more than four. Joint frames are aligned with the world in the T-pose;
    metres, y up, facing +z, which is also glTF's convention. A motion has poses of the body's joints and is linear
    between frames. Raises `AvatarError` for more than 256 joints, when the motion does not fit the body or is not
    finite, or without pygltflib; `DataError` for a file name that does not end in .glb.
    """
    path = Path(path)
    check_suffix(path, (".glb",), "a file name")
    if len(body.parents) > 256:
        raise AvatarError(f"body: expected at most 256 joints, got {len(body.parents)}.")
    gltf = require("pygltflib")
    document = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="avatar"))
    buffer = _Buffer(gltf, document)
    _add_mesh(gltf, document, buffer, body)
    _add_skeleton(gltf, document, buffer, body)
    if motion is not None:
        _add_motion(gltf, document, buffer, body, motion)
    data = bytes(buffer.data)
    document.buffers = [gltf.Buffer(byteLength=len(data))]
    document.set_binary_blob(data)
    write_whole(path, b"".join(document.save_to_bytes()))


class _Buffer:
    """The binary part of a glTF file; every array becomes a buffer view and an accessor."""

    def __init__(self, gltf: Any, document: Any):
        self.gltf, self.document, self.data = gltf, document, bytearray()

    def add(self, values: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Appends an array, one row an element, and returns its accessor's index."""
        kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
        components = {"float32": 5126, "uint32": 5125, "uint8": 5121}
        rows = np.ascontiguousarray(values).reshape(len(values), -1)
        raw = rows.astype(rows.dtype.newbyteorder("<")).tobytes()
        view = self.gltf.BufferView(buffer=0, byteOffset=len(self.data), byteLength=len(raw), target=target)
        self.data += raw + b"\0" * (-len(raw) % 4)  # accessors begin at multiples of four bytes
        limits = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()} if bounds else {}
        place, kind = {"bufferView": len(self.document.bufferViews), "count": len(rows)}, kinds[rows.shape[1]]
        accessor = self.gltf.Accessor(**place, componentType=components[rows.dtype.name], type=kind, **limits)
        self.document.bufferViews.append(view)
        self.document.accessors.append(accessor)
        return len(self.document.accessors) - 1


def _add_mesh(gltf: Any, document: Any, buffer: _Buffer, body: BodyModel) -> None:
    """The skinned mesh in its bind pose, as node 0."""
    vertices, weights, faces = body.bind_vertices.float().cpu(), body.weights.float().cpu(), body.faces.cpu()
    sets = min(MAX_SETS, -(-int((weights > 0).sum(dim=1).max()) // INFLUENCES))
    width = sets * INFLUENCES
    padded = torch.nn.functional.pad(weights, (0, max(0, width - weights.shape[1])))
    kept, joints = padded.topk(width, dim=1)
    kept, joints = kept / kept.sum(dim=1, keepdim=True), joints * (kept > 0)
    attributes = gltf.Attributes(
        POSITION=buffer.add(vertices.numpy(), ARRAY_BUFFER, bounds=True),
        NORMAL=buffer.add(vertex_normals(vertices, faces).numpy(), ARRAY_BUFFER),
    )
    for index in range(sets):
        part = slice(index * INFLUENCES, (index + 1) * INFLUENCES)
        chosen = joints[:, part].numpy().astype(np.uint8)
        setattr(attributes, f"JOINTS_{index}", buffer.add(chosen, ARRAY_BUFFER))
        setattr(attributes, f"WEIGHTS_{index}", buffer.add(kept[:, part].numpy(), ARRAY_BUFFER))
    corners = buffer.add(faces.numpy().astype(np.uint32).reshape(-1), ELEMENT_BUFFER)
    shading = gltf.PbrMetallicRoughness(baseColorFactor=CLAY, metallicFactor=0.0, roughnessFactor=0.9)
    document.materials.append(gltf.Material(name="clay", pbrMetallicRoughness=shading))
    surface = gltf.Primitive(attributes=attributes, indices=corners, material=0)
    document.meshes.append(gltf.Mesh(name="body", primitives=[surface]))
    document.nodes.append(gltf.Node(name="body", mesh=0, skin=0))


def _add_skeleton(gltf: Any, document: Any, buffer: _Buffer, body: BodyModel) -> None:
    """Joint j as node j + 1, in the T-pose, and the skin that binds the mesh to them."""
    joints = body.zero_joints.double().cpu()
    for joint, parent in enumerate(body.parents):
        offset = joints[joint] - joints[parent] if parent >= 0 else joints[joint]
        children = [child + 1 for child, above in enumerate(body.parents) if above == joint]
        document.nodes.append(gltf.Node(name=body.joint_names[joint], translation=offset.tolist(), children=children))
    joint_from_bind = body.zero_from_bind.double().cpu().clone()
    joint_from_bind[:, :3, 3] -= joints
    columns = buffer.add(joint_from_bind.transpose(1, 2).float().numpy())  # glTF stores matrices column by column
    nodes = [joint + 1 for joint in range(len(joints))]
    document.skins.append(gltf.Skin(name="skeleton", inverseBindMatrices=columns, joints=nodes, skeleton=1))
    document.scenes.append(gltf.Scene(nodes=[0, 1]))
    document.scene = 0


def _add_motion(gltf: Any, document: Any, buffer: _Buffer, body: BodyModel, motion: Motion) -> None:
    """One rotation track a joint and a translation track for the root."""
    dims = check_shape("motion.poses", motion.poses, "T J 3", J=len(body.parents))
    check_shape("motion.translations", motion.translations, "T 3", T=dims["T"])
    check_finite("motion.poses", motion.poses)
    check_finite("motion.translations", motion.translations)
    if not dims["T"] or not 0 < motion.fps <= 1000:
        raise AvatarError(f"motion: expected frames and fps in (0, 1000], got {dims['T']} at {motion.fps}.")
    import roma

    quaternions = roma.rotvec_to_unitquat(torch.as_tensor(motion.poses, dtype=torch.float64)).numpy()
    signs = np.sign(np.einsum("tjc,tjc->tj", quaternions[1:], quaternions[:-1]))
    signs = np.cumprod(np.where(signs < 0, -1, 1), axis=0)  # neighbours on one side, for the short way between
    quaternions[1:] *= signs[..., None]
    root = motion.translations + body.zero_joints[0].double().cpu().numpy()
    times = buffer.add((np.arange(dims["T"]) / motion.fps).astype(np.float32), bounds=True)
    tracks = [(joint + 1, "rotation", quaternions[:, joint]) for joint in range(dims["J"])]
    animation = gltf.Animation(name=motion.name, samplers=[], channels=[])
    for node, what, values in [*tracks, (1, "translation", root)]:
        output = buffer.add(values.astype(np.float32))
        animation.samplers.append(gltf.AnimationSampler(input=times, output=output, interpolation="LINEAR"))
        target = gltf.AnimationChannelTarget(node=node, path=what)
        animation.channels.append(gltf.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))
    document.animations.append(animation)
