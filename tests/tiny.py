"""A small outfit in the open layout whose garment follows from the pose, for tests of data and training."""

from pathlib import Path

import numpy as np
import torch
import yaml

from avatar.body.open import open_body
from avatar.data.layouts import OpenOutfit
from avatar.geometry.neighbours import nearest
from avatar.geometry.surface import vertex_normals
from avatar.geometry.transforms import transform_directions, transform_points
from avatar.io.frames import OpenFrame, OpenGarment, write_manifest, write_open_frame, write_open_garment
from avatar.methods.losses import LossConfig
from avatar.methods.settings import Schedule, TrainConfig
from avatar.records import CanonicalScan, ClothedTemplate, Template
from avatar.simulate.angles import pose_from_angles

HIERARCHY = {"points": [256, 64], "radii": [0.3, 1.0], "neighbours": 16}
ENCODER = {"hierarchy": HIERARCHY, "abstraction": [[16, 16], [32, 32]], "propagation": [[32], [16]]}
DECODER = {"width": 48, "trunk": 2, "branch": 0}
SETTINGS = {
    "pose_encoder": ENCODER,
    "garment_encoder": ENCODER,
    "garment_decoder": DECODER,
    "pose_decoder": DECODER,
    "code_channels": 4,
}

EASE = 0.02  # metres between body and cloth
BULGE = 0.05  # metres by which the belly and hips bulge at the far end of the poses
TRAIN_SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
TEST_SHARES = (0.15, 0.5, 0.85)


def tiny_pose(share: float) -> np.ndarray:
    """A pose on a line from arms down and standing (0) to arms raised and knees bent (1), ``(22, 3)``."""
    angles = {}
    for side in ("left", "right"):
        angles |= {
            f"{side}_arm_abduction": 35 + 80 * share,
            f"{side}_elbow_flexion": 15 + 50 * share,
            f"{side}_hip_flexion": 40 * share,
            f"{side}_knee_flexion": 5 + 60 * share,
        }
    return pose_from_angles(angles | {"trunk_bend": 20 * share}, 1)[0]


def write_tiny_outfit(folder: Path, ease: float = EASE) -> Path:
    """Writes six train and three test frames of a tunic: trunk and hips of the body, pushed out by ``ease`` metres.

    Its belly bulges in proportion to how far the pose has gone from `tiny_pose` 0 to 1, so a method that knows the
    pose does better than the best pose-independent garment; its lower half is a second garment. Skin under it
    cannot be seen.
    """
    folder = Path(folder)
    body = open_body("female")
    template = body.template
    trunk = [template.joint_names.index(name) for name in ("pelvis", "spine1", "spine2", "spine3")]
    covered = (template.weights[:, trunk].sum(dim=1) > 0.6)[template.faces].all(dim=1)
    used, corners = torch.unique(template.faces[covered], return_inverse=True)
    outward = vertex_normals(template.vertices, template.faces)[used]
    canonical = template.vertices[used] + ease * outward
    belly = torch.tensor([0.0, 0.28, 0.12])
    bulge = BULGE * torch.exp(-((canonical - belly) / 0.16).square().sum(dim=1, keepdim=True)) * outward
    labels = np.where(canonical[:, 1].numpy() > 0.25, 1, 2).astype(np.uint8)
    garment = OpenGarment(corners.numpy().reshape(-1, 3), canonical.numpy(), labels, ("tunic", "shorts"))
    write_open_garment(folder / "garment.npz", garment)
    settings = {"format": "outfit/1", "layout": "open", "body": {"model": "open", "shape": "female", "canonical": "t"}}
    (folder / "outfit.yaml").write_text(yaml.safe_dump(settings))
    for split, sequence, shares in (("train", "rise", TRAIN_SHARES), ("test", "check", TEST_SHARES)):
        for number, share in enumerate(shares):
            pose, translation = tiny_pose(share), np.array([0.1, 0.0, 0.2 * share], np.float32)
            posed = body(torch.from_numpy(pose)[None], torch.from_numpy(translation)[None])
            carried = posed.vertex_transforms[0][used]
            cloth = transform_points(carried, canonical) + transform_directions(carried, share * bulge)
            visible_cloth = np.ones(len(garment.faces), bool)
            frame = OpenFrame(pose, translation, cloth.numpy(), ~covered.numpy(), visible_cloth)
            write_open_frame(folder / split / f"{sequence}.{number:05d}.npz", frame)
    write_manifest(folder)
    return folder


def quick_training(**options) -> TrainConfig:
    """Training that learns the tiny outfit in seconds."""
    defaults = {"batch": 2, "fresh_points": True, "lr": 5e-3, "code_lr": 1e-2, "schedule": Schedule.cosine}
    return TrainConfig(**(defaults | {"loss": LossConfig(offset=20, normal_start=0.3)} | options))


def canonical_truth(outfit: OpenOutfit, split: str, name: str) -> CanonicalScan:
    """A frame's scan where its points truly belong at rest, as the best canonicalizer would carry it."""
    scan, template = outfit.load(split, name).scan, outfit.template
    points = torch.from_numpy(scan.canonical)
    ids = nearest(points[None], template.vertices[None])[0]
    normals = vertex_normals(template.vertices, template.faces)[ids].numpy()
    return CanonicalScan(scan.canonical, normals, template.weights[ids].numpy(), np.arange(len(points)))


def trunk_garment(template: Template) -> ClothedTemplate:
    """A clothed template made by hand: the trunk, pushed out by 2 cm, as garment over the body's other skin."""
    names = [template.joint_names.index(name) for name in ("pelvis", "spine1", "spine2", "spine3")]
    trunk = (template.weights[:, names].sum(dim=1) > 0.5).numpy()
    vertices, faces = template.vertices.numpy(), template.faces.numpy()
    pushed = vertices + 0.02 * vertex_normals(template.vertices, template.faces).numpy()
    (skin, low), (top, high) = (
        np.unique(faces[part], return_inverse=True) for part in (~trunk[faces].all(axis=1), trunk[faces].all(axis=1))
    )
    return ClothedTemplate(
        vertices=np.concatenate([vertices[skin], pushed[top]]),
        faces=np.concatenate([low.reshape(-1, 3), high.reshape(-1, 3) + len(skin)]),
        weights=np.concatenate([template.weights.numpy()[rows] for rows in (skin, top)]),
        body_vertex=np.concatenate([skin, np.full(len(top), -1)]),
        covered=np.zeros(len(skin) + len(top), bool),
    )
