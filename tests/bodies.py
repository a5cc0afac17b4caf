"""Random bodies of a few vertices for tests of bodies and commands."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.body.model import BodyModel
from avatar.body.skinning import chain_transforms
from avatar.body.smpl import joint_tree
from avatar.records import Template

VERTICES = 40


@dataclass
class RandomModel:
    """The parameters of an SMPL-like model, as its file has them."""

    v_template: np.ndarray
    shapedirs: np.ndarray
    posedirs: np.ndarray
    J_regressor: np.ndarray
    weights: np.ndarray
    f: np.ndarray
    kintree_table: np.ndarray


def random_model(kind: str = "smpl", seed: int = 0, components: int = 10) -> RandomModel:
    """Random parameters with the joints of a kind of model; regressor and weights have rows summing to 1."""
    rng = np.random.default_rng(seed)
    parents = joint_tree(kind)[1]
    joints = len(parents)
    regressor, weights = rng.random((joints, VERTICES)) ** 4, rng.random((VERTICES, joints)) ** 8
    return RandomModel(
        v_template=rng.normal(size=(VERTICES, 3)),
        shapedirs=rng.normal(size=(VERTICES, 3, components)) * 0.1,
        posedirs=rng.normal(size=(VERTICES, 3, 9 * (joints - 1))) * 0.01,
        J_regressor=regressor / regressor.sum(axis=1, keepdims=True),
        weights=weights / weights.sum(axis=1, keepdims=True),
        f=rng.integers(0, VERTICES, (30, 3)).astype(np.uint32),
        kintree_table=np.stack([np.array([2**32 - 1, *parents[1:]]), np.arange(joints)]).astype(np.uint32),
    )


def random_bind(joints: int = 5, seed: int = 0) -> Template:
    """A random template over a random tree, float64."""
    rng = np.random.default_rng(seed)
    weights = rng.random((VERTICES, joints)) ** 4 + 1e-3
    return Template(
        vertices=torch.tensor(rng.normal(size=(VERTICES, 3))),
        faces=torch.tensor(rng.integers(0, VERTICES, (30, 3))),
        weights=torch.tensor(weights / weights.sum(axis=1, keepdims=True)),
        joints=torch.tensor(rng.normal(size=(joints, 3))),
        parents=(-1, *(int(rng.integers(0, joint)) for joint in range(1, joints))),
        joint_names=tuple(f"joint{j}" for j in range(joints)),
    )


def random_pose(*shape: int, seed: int = 0, spread: float = 0.5) -> Tensor:
    """Axis-angle vectors ``(*shape, 3)``, float64."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, 3, generator=generator, dtype=torch.float64) * spread


def random_body(canonical: bool = False, correctives: bool = False) -> BodyModel:
    """A body bound away from its zero pose, float64; with another canonical pose and pose blendshapes if asked."""
    bind = random_bind()
    zero_from_bind = chain_transforms(random_pose(1, 5, seed=1), bind.joints, bind.parents)[0]
    directions = torch.tensor(np.random.default_rng(2).normal(size=(VERTICES, 3, 36)) * 0.02)
    return BodyModel(
        bind,
        zero_from_bind,
        random_pose(5, seed=3) if canonical else None,
        directions if correctives else None,
    )


def distinct(model: dict) -> dict:
    """A model whose triangles are 30 different ones of three different vertices."""
    faces = np.random.default_rng(4).permuted(np.tile(np.arange(40), (30, 1)), axis=1)[:, :3]
    return model | {"f": faces.astype(np.uint32)}


def write_unwrapped(path: Path, model: dict, places: np.ndarray) -> Path:
    """An OBJ of a model in which every corner of every triangle has a texture coordinate of its own ``(3 F, 2)``."""
    lines = ["v 0 0 0"] * len(model["v_template"]) + [f"vt {u:.9f} {v:.9f}" for u, v in places]
    for number, face in enumerate(model["f"]):
        lines.append("f " + " ".join(f"{vertex + 1}/{3 * number + corner + 1}" for corner, vertex in enumerate(face)))
    path.write_text("\n".join(lines))
    return path
