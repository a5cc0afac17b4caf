"""Bodies and canonical poses by name: what a configuration may ask for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from avatar.body.model import BodyModel
from avatar.body.open import Phenotype, anny_body, open_body
from avatar.body.packed import holds_template, packed_body
from avatar.body.rigged import rigged_body
from avatar.body.smpl import DOWNLOAD_PAGES, converted_kind, smpl_body, way_to_file
from avatar.checks import AvatarError, unknown_name
from avatar.io.rigs import RIG_SUFFIXES
from avatar.settings import settings_from_dict

OWN_FILES = {"packed": "the template.npz of a dataset's outfit", "rigged": "a rigged GLB or glTF file"}
CANONICAL_POSES = {"t": 0.0, "apart": 25.0}  # degrees by which each hip is turned outwards


@dataclass
class BodyConfig:
    """Which body, in which shape, with which canonical pose."""

    name: str = "open"  # open, anny, smpl, smplh, smplx, packed or rigged
    shape: str = "female"  # open: one of the asset's shapes, or mean
    phenotype: Phenotype = field(default_factory=Phenotype)  # anny: shape parameters, each in [0, 1]
    path: str = ""  # file of tools/convert_body.py; packed: template.npz or tools/make_body.py's; rigged: GLB or glTF
    betas: list[float] = field(default_factory=list)  # smpl, smplh, smplx: shape, standard deviations
    all_joints: bool = True  # smpl, smplh, smplx: all joints of the file; false: hands and face at rest, 22 joints
    canonical: str = "t"  # t, or apart (hips 25 degrees outwards, for skirts)

    def __post_init__(self):
        if self.name not in BODIES:
            raise unknown_name("body.name", self.name, BODIES)
        if self.canonical not in CANONICAL_POSES:
            raise unknown_name("body.canonical", self.canonical, CANONICAL_POSES)
        if self.betas and self.name not in DOWNLOAD_PAGES:
            raise AvatarError(f"body.betas: expected none, as a body of kind {self.name} has no such shape.")
        if self.name in OWN_FILES and not self.path:
            raise AvatarError(f"body.path: expected {OWN_FILES[self.name]}, got none.")
        if self.name in DOWNLOAD_PAGES and not self.path:
            raise AvatarError(f"body.path: expected a {self.name} file, got none. {way_to_file(self.name)}")


def load_body(config: BodyConfig) -> BodyModel:
    """The body a configuration names, float32; errors as in the function of its kind."""
    body = BODIES[config.name](config)
    return body.with_canonical_pose(canonical_pose(config.canonical, body.joint_names))


def body_of_file(path: Path, settings: dict[str, Any], name: str = "") -> BodyModel:
    """The body in a file: a converted SMPL, SMPL-H or SMPL-X model, a ``template.npz`` (see `packed_body`), or a rigged
    GLB or glTF file (see `rigged_body`).

    Settings are options of `BodyConfig` but ``name`` and ``path``; ``model``, if any, is what the file must hold, and
    ``name`` where they stand, for messages. Raises `AvatarError` for an unknown option; `DataError` for a missing or
    damaged file or one of another kind, with the command that makes a good one.
    """
    given = dict(settings)
    model = given.pop("model", None)
    if model is None and Path(path).suffix.lower() in RIG_SUFFIXES:
        model = "rigged"
    model = model or ("packed" if holds_template(path) else converted_kind(path))
    return load_body(settings_from_dict(BodyConfig, {**given, "name": model, "path": str(path)}, name))


def canonical_pose(name: str, joint_names: Sequence[str]) -> Tensor:
    """A canonical pose of `CANONICAL_POSES`, ``(J, 3)`` axis-angle; `AvatarError` without the joints it needs."""
    if name not in CANONICAL_POSES:
        raise unknown_name("canonical pose", name, CANONICAL_POSES)
    pose = torch.zeros(len(joint_names), 3)
    if CANONICAL_POSES[name]:
        for joint, outwards in (("left_hip", 1), ("right_hip", -1)):
            if joint not in joint_names:
                raise AvatarError(f"canonical pose {name!r}: expected a joint {joint}, got {', '.join(joint_names)}.")
            pose[list(joint_names).index(joint), 2] = outwards * math.radians(CANONICAL_POSES[name])
    return pose


def canonical_name(body: BodyModel) -> str:
    """The name of a body's canonical pose. Raises `AvatarError` for a pose that has none."""
    for name in CANONICAL_POSES:
        if torch.allclose(canonical_pose(name, body.joint_names).to(body.canonical_pose), body.canonical_pose):
            return name
    raise AvatarError(f"canonical pose: expected one of {', '.join(CANONICAL_POSES)}, got another.")


def _smpl(config: BodyConfig) -> BodyModel:
    return smpl_body(Path(config.path), config.betas, config.all_joints, kind=config.name)


BODIES = {
    "open": lambda config: open_body(config.shape),
    "anny": lambda config: anny_body(config.phenotype),
    **dict.fromkeys(DOWNLOAD_PAGES, _smpl),
    "packed": lambda config: packed_body(Path(config.path)),
    "rigged": lambda config: rigged_body(Path(config.path)),
}
