"""Someone else's body in SMPL's own file format, and packed frames of that person: nothing in it is the open body's.

Another mesh (a few thousand vertices), 24 joints, a shape (betas), pose blendshapes, bound in the T-pose. Frames are
posed by `pose_person`, plain numpy in float64, so that what the program makes of them can be judged.
"""

import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tiny import tiny_pose

from avatar.body.model import SMPL_JOINTS
from avatar.body.open import open_body
from avatar.body.smpl import joint_tree
from avatar.geometry.surface import vertex_normals

BETAS = (0.8, -0.5, 0.3)
CELL = 0.03  # metres; the open body's vertices in one cell become one
CLOTH = 0.015  # metres of cloth over the skin
ORIGIN = np.array([0.0, 0.4, 0.0])  # the open body's is another: its pelvis lies higher
PARENTS = joint_tree("smpl")[1]


@dataclass(frozen=True)
class PosedPerson:
    """Vertices ``(V, 3)`` and their transforms from rest ``(V, 4, 4)``, float64."""

    vertices: np.ndarray
    transforms: np.ndarray


def person_model() -> dict[str, np.ndarray]:
    """The arrays of the model's file, with SMPL's names."""
    source = open_body("male").template
    vertices, faces, owners = merged_vertices(source.vertices.double().numpy() - ORIGIN, source.faces.numpy())
    weights = np.concatenate([source.weights.double().numpy()[owners], np.zeros((len(vertices), 2))], axis=1)
    joints = np.concatenate([source.joints.double().numpy() - ORIGIN, np.zeros((2, 3))])
    for hand, side, sign in ((22, "left", 1), (23, "right", -1)):
        wrist = SMPL_JOINTS.index(f"{side}_wrist")
        joints[hand] = joints[wrist] + [sign * 0.08, 0, 0]
        share = np.clip((sign * (vertices[:, 0] - joints[wrist, 0]) - 0.03) / 0.1, 0, 1)
        weights[:, hand], weights[:, wrist] = share * weights[:, wrist], (1 - share) * weights[:, wrist]
    regressor = np.zeros((24, len(vertices)))
    for joint, near in enumerate(cKDTree(vertices).query(joints, 24)[1]):  # least weights that give the joint
        system = np.concatenate([vertices[near].T, np.ones((1, 24))])
        regressor[joint, near] = np.linalg.lstsq(system, np.append(joints[joint], 1), rcond=None)[0]
    rng = np.random.default_rng(0)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()

    def bumps(count: int, size: float) -> np.ndarray:
        waves = np.sin(vertices @ rng.normal(scale=4, size=(3, count)) + rng.uniform(0, 6, count))
        return size * normals[:, :, None] * waves[:, None]

    shapes = bumps(10, 0.004)
    shapes[..., 0] += vertices * 0.03
    return {
        "v_template": vertices,
        "f": faces.astype(np.uint32),
        "weights": weights,
        "J_regressor": regressor,
        "shapedirs": shapes,
        "posedirs": bumps(207, 0.002),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)], np.int64).astype(np.uint32),
    }


def merged_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A coarser mesh: vertices of one cell become their mean; with one old vertex for each new one."""
    _, owners, ids = np.unique(np.floor(vertices / CELL), axis=0, return_index=True, return_inverse=True)
    merged = np.stack([np.bincount(ids.ravel(), column) for column in vertices.T], axis=1)
    corners = ids.ravel()[faces]
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return merged / np.bincount(ids.ravel())[:, None], np.unique(corners[whole], axis=0), owners


def write_model(path: Path, model: dict[str, np.ndarray]) -> Path:
    """The model as SMPL's pickle has it: a sparse regressor, and entries that nobody needs."""
    stored = {**model, "J_regressor": scipy.sparse.csc_matrix(model["J_regressor"]), "bs_style": "lbs"}
    path.write_bytes(pickle.dumps({**stored, "bs_type": "lrotmin"}, protocol=2))
    return path


def pose_person(model: dict[str, np.ndarray], pose: np.ndarray, translation: np.ndarray) -> PosedPerson:
    """The person in a pose ``(24, 3)``: SMPL's published equations, joint by joint."""
    shaped = model["v_template"] + model["shapedirs"][..., : len(BETAS)] @ BETAS  # the person's own shape
    joints = model["J_regressor"] @ shaped
    turns = Rotation.from_rotvec(pose).as_matrix()
    rest = shaped + model["posedirs"] @ (turns[1:] - np.eye(3)).ravel()
    bones = np.tile(np.eye(4), (24, 1, 1))
    for joint, parent in enumerate(PARENTS):
        bones[joint, :3, :3] = turns[joint]
        bones[joint, :3, 3] = joints[joint] - turns[joint] @ joints[joint]
        bones[joint] = bones[max(parent, 0)] @ bones[joint] if joint else bones[joint]
    transforms = np.einsum("vj,jab->vab", model["weights"], bones)
    vertices = np.einsum("vab,vb->va", transforms[:, :3, :3], rest) + transforms[:, :3, 3] + translation
    return PosedPerson(vertices, transforms)


def rest_joints(model: dict[str, np.ndarray]) -> np.ndarray:
    """The person's body joints in the T-pose, ``(22, 3)``."""
    return (model["J_regressor"] @ (model["v_template"] + model["shapedirs"][..., : len(BETAS)] @ BETAS))[:22]


def whole_pose(pose: np.ndarray) -> np.ndarray:
    """A pose of 22 joints with both hands at rest, ``(24, 3)``."""
    return np.concatenate([pose, np.zeros((2, 3), pose.dtype)])


def frame_arrays(model: dict[str, np.ndarray], share: float, turn: float = 0.4) -> dict[str, np.ndarray]:
    """A packed frame with POP's keys, and ours for the pose: the person in `tiny_pose`, fingers bent, under cloth."""
    pose, translation = whole_pose(tiny_pose(share)), np.array([0.3, 0.1, 0.2 + share])
    pose[0], pose[22:, 2] = [0, turn, 0], [-0.3, 0.3]
    posed = pose_person(model, pose, translation)
    faces = model["f"].astype(np.int64)
    normals = vertex_normals(torch.from_numpy(posed.vertices), torch.from_numpy(faces)).numpy()
    rng = np.random.default_rng(round(1000 * share))
    corners = (posed.vertices + CLOTH * normals)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    hit = rng.choice(len(faces), 4000, p=areas / areas.sum())
    points = np.einsum("mc,mcx->mx", rng.dirichlet(np.ones(3), 4000), corners[hit])
    arrays = {"body_verts": posed.vertices, "vtransf": posed.transforms, "scan_pc": points}
    arrays |= {"scan_n": across[hit] / areas[hit, None], "pose": pose, "translation": translation}
    arrays = {key: value.astype(np.float32) for key, value in arrays.items()}
    return arrays | {"scan_name": np.array("person"), "posmap32": np.zeros((32, 32, 3), np.float32)}


def write_person(folder: Path, model: dict[str, np.ndarray], yaml: str, kept: set[str] | None = None) -> Path:
    """Three train and two test frames of the person, and what ``outfit.yaml`` says; ``kept`` are the frames' keys."""
    for split, sequence, shares in (("train", "rise", (0.0, 0.5, 1.0)), ("test", "check", (0.25, 0.75))):
        (folder / split).mkdir(parents=True)
        for number, share in enumerate(shares):
            arrays = frame_arrays(model, share)
            arrays = {key: value for key, value in arrays.items() if kept is None or key in kept}
            np.savez(folder / split / f"{sequence}.{number:05d}.npz", **arrays)
    (folder / "outfit.yaml").write_text(yaml)
    return folder
