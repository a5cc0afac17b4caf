"""Skinned meshes of glTF files with their skeletons, as they are bound: what a body is made from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.checks import DataError, check_file, check_finite, check_suffix
from avatar.io.gltf import (
    MAX_BYTES,
    TRIANGLES,
    Scene,
    open_scene,
    primitive_faces,
    read_accessor,
    read_influences,
    reading_gltf,
    scene_nodes,
    skin_joints,
)
from avatar.io.npz import naming

RIG_SUFFIXES = (".glb", ".gltf")
MAX_WEIGHTS = 1 << 28  # vertices times joints
SAME = 1e-4  # of a mesh's size: by how much two meshes of one skeleton may be bound differently


@dataclass(frozen=True)
class Rig:
    """A skinned mesh and its J joints, parents before children, in the file's own unit and axes."""

    vertices: np.ndarray  # (V, 3) as bound
    faces: np.ndarray  # (F, 3)
    weights: np.ndarray  # (V, J) rows sum to 1
    names: tuple[str, ...]
    parents: tuple[int, ...]  # the nearest joint above, -1 where there is none
    scene_from_bound: np.ndarray  # (J, 4, 4) motions in the pose that the joints are stored in
    places: np.ndarray  # (J, 3) of the joints in that pose
    uv: np.ndarray | None = None  # (U, 2) in [0, 1], v upwards
    uv_faces: np.ndarray | None = None  # (F, 3)


@dataclass
class _Bound:
    """The vertices of one primitive, in the frame of the first skin."""

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    uv: np.ndarray | None


def read_rig(path: Path) -> Rig:
    """The skinned meshes of a GLB or glTF file as one; others, such as props without a skin, are left out.

    Vertices that were split at seams of the texture are joined again, where position and weights are the same, in the
    order of their first ones. Raises `DataError` as `read_gltf` does, for a file without a skin, and for meshes with
    different skeletons.
    """
    path = Path(path)
    check_suffix(path, RIG_SUFFIXES, "a rigged glTF file")
    check_file(path, MAX_BYTES)
    with reading_gltf(path), np.errstate(all="ignore"):
        return _read(open_scene(path, path.read_bytes()))


def _read(scene: Scene) -> Rig:
    skins: dict[int, np.ndarray] = {}
    parts: list[_Bound] = []
    for node, _, world in scene_nodes(scene):
        if (skin := node.get("skin")) is not None:
            skins.setdefault(skin, skin_joints(scene, skin, world))
            parts += _bound_parts(scene, node["mesh"], skins[skin], _between(scene, skins, skin))
            places = world
    if not parts:
        hint = "Hint: export the mesh with its armature and skinning weights."
        raise DataError(scene.path, "expected a skinned mesh with triangles, got none.", hint)
    first = next(iter(skins))
    with naming(scene.path):
        check_finite("inverse bind matrices", skins[first])
        for part in parts:
            check_finite("vertices", part.vertices)
    nodes = scene.item("skins", first)["joints"]
    order, parents = _joint_order(scene, nodes)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets)])
    vertices, weights = (np.concatenate([getattr(part, key) for part in parts]) for key in ("vertices", "weights"))
    weights = weights[:, order].astype(np.float32)
    owners, kept = _joined(np.concatenate([vertices.astype(np.float32), weights], axis=1), faces)
    uv, uv_faces = None, None
    if all(part.uv is not None for part in parts):
        uv, uv_faces = np.concatenate([part.uv for part in parts]) * (1, -1) + (0, 1), faces
        if not (np.isfinite(uv).all() and (uv[faces] >= 0).all() and (uv[faces] <= 1).all()):
            uv, uv_faces = None, None
    return Rig(
        vertices=vertices[kept],
        faces=owners[faces],
        weights=weights[kept],
        names=tuple(str(scene.item("nodes", nodes[joint]).get("name", f"joint{joint}")) for joint in order),
        parents=parents,
        scene_from_bound=skins[first][order],
        places=np.stack([places[nodes[joint]][:3, 3] for joint in order]),
        uv=uv,
        uv_faces=uv_faces,
    )


def _between(scene: Scene, skins: dict[int, np.ndarray], skin: int) -> np.ndarray:
    """The transform ``(4, 4)`` from a skin's own frame to that of the first skin, which must have the same joints."""
    first = next(iter(skins))
    if scene.item("skins", skin)["joints"] != scene.item("skins", first)["joints"]:
        hint = "Hint: join the meshes, or export the body alone."
        raise DataError(scene.path, "expected meshes with one skeleton, got several.", hint)
    between = np.linalg.solve(skins[first], skins[skin])
    if np.abs(between - between[0]).max() > SAME * max(np.abs(between[0]).max(), 1):
        hint = "Hint: join the meshes, or export the body alone."
        raise DataError(scene.path, "expected meshes bound in one pose, got several.", hint)
    return between[0]


def _bound_parts(scene: Scene, mesh: int, joints: np.ndarray, transform: np.ndarray) -> list[_Bound]:
    """Primitives of a skinned mesh that have triangles."""
    parts = []
    for primitive in scene.item("meshes", mesh)["primitives"]:
        attributes, mode = primitive["attributes"], primitive.get("mode", TRIANGLES)
        if mode < TRIANGLES:
            continue
        vertices = read_accessor(scene, attributes["POSITION"], "VEC3")
        if len(vertices) * len(joints) > MAX_WEIGHTS:
            raise DataError(scene.path, f"expected a person, got {len(vertices)} vertices and {len(joints)} joints.")
        ids, values = read_influences(scene, attributes, len(joints), len(vertices))
        weights = np.zeros((len(vertices), len(joints)))
        np.add.at(weights, (np.arange(len(ids))[:, None], ids), values)
        uv = read_accessor(scene, attributes["TEXCOORD_0"], "VEC2") if "TEXCOORD_0" in attributes else None
        faces = primitive_faces(scene, primitive, mode, len(vertices))
        parts.append(_Bound(vertices @ transform[:3, :3].T + transform[:3, 3], faces, weights, uv))
    return parts


def _joint_order(scene: Scene, nodes: list[int]) -> tuple[list[int], tuple[int, ...]]:
    """Joints of a skin, parents before children, and their parents in that order; nodes between joints are skipped."""
    above = {child for node in scene.json["nodes"] for child in node.get("children", [])}
    joint = {node: number for number, node in enumerate(nodes)}
    if len(joint) < len(nodes):
        raise DataError(scene.path, "expected every joint of its skin once, got one twice.")
    order: list[int] = []
    parents: list[int] = []
    stack = [(index, -1) for index in reversed(range(len(scene.json["nodes"]))) if index not in above]
    while stack:
        at, over = stack.pop()
        if at in joint:
            order.append(joint[at])
            parents.append(over)
            over = len(order) - 1
        stack += [(child, over) for child in reversed(scene.json["nodes"][at].get("children", []))]
    return order, tuple(parents)


def _joined(rows: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The joined vertex ``(V,)`` of each vertex, -1 for those of no face, and the first vertex of each joined one."""
    used = np.unique(faces)
    first, inverse = np.unique(rows[used], axis=0, return_index=True, return_inverse=True)[1:]
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    owners = np.full(len(rows), -1)
    owners[used] = rank[inverse.reshape(-1)]
    return owners, used[np.sort(first)]
