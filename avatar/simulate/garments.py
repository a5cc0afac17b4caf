"""Garments cut from the body: an offset surface in the bind pose, hung, clipped and evened out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from avatar.body.model import BodyModel
from avatar.checks import AvatarError
from avatar.geometry.transforms import invert_rigid, transform_points
from avatar.geometry.trees import build_tree
from avatar.simulate import level_sets
from avatar.simulate.mesh_queries import body_distances, lift_off
from avatar.simulate.outfits import GarmentConfig

PAD = 0.12  # metres of free grid around the body
SHORTEST = 0.45  # shortest edge in the finished mesh, in target edge lengths, before the last relaxation
BLUR = 0.012  # metres by which the field is smoothed
CROTCH = 0.06  # metres of gap between the thighs that is bridged softly
NECK_FOOT = 0.04  # metres above the neck joint where garments end at the latest
BLEND = 0.03  # metres over which a hanging tube melts into the close-fitting part
HOOD_EASE, HOOD_NECK = 0.006, 0.1  # metres: more ease around the head, radius around the neck
FACE_HALF_WIDTH = 0.092  # metres
LEVELS = ("left_ankle", "left_knee", "left_hip", "spine1", "spine3", "neck")
ARM_JOINTS = ("shoulder", "elbow", "wrist")


class Cutting:
    """The body a garment is cut on: bind-pose ``vertices``, ``faces``, ``joints`` by name, and weights ``(V,)`` of the
    ``arms`` and of the ``head``.
    """

    def __init__(self, body: BodyModel):
        joints = transform_points(invert_rigid(body.zero_from_bind), body.zero_joints).double().numpy()
        arm_ids = [body.joint_names.index(f"{side}_{j}") for side in ("left", "right") for j in ARM_JOINTS]
        self.vertices, self.faces = body.bind_vertices.double().numpy(), body.faces.numpy()
        self.joints = dict(zip(body.joint_names, joints))
        self.arms = body.weights[:, arm_ids].sum(dim=1).double().numpy()
        self.head = body.weights[:, body.joint_names.index("head")].double().numpy()

    def height(self, level: float) -> float:
        """Height in metres of a level on the body (see `GarmentConfig`)."""
        return float(np.interp(level, range(len(LEVELS)), [self.joints[name][1] for name in LEVELS]))

    def profile(self, heights: np.ndarray) -> np.ndarray:
        """Extents ``(H, 3)`` of the trunk and legs at given heights: half width, back, front."""
        trunk = self.vertices[self.arms < 0.3]
        rows = []
        for height in heights:
            near = trunk[np.abs(trunk[:, 1] - height) < 0.02]
            rows.append((np.abs(near[:, 0]).max(), near[:, 2].min(), near[:, 2].max()) if len(near) else (0, 0, 0))
        return np.array(rows)


@dataclass(frozen=True)
class Garment:
    """A garment mesh in the bind pose: ``vertices (V, 3)`` metres, ``faces (F, 3)``, and its configuration."""

    config: GarmentConfig
    vertices: np.ndarray
    faces: np.ndarray


def cut_garment(body: BodyModel, config: GarmentConfig) -> Garment:
    """Cuts a garment on a body in its bind pose: one connected, consistently wound mesh outside the body.

    Raises `AvatarError` when the settings leave nothing to wear.
    """
    cutting = Cutting(body)
    grid = garment_field(cutting, config)
    vertices, faces = level_sets.surface_nets(grid)
    vertices = level_sets.relax(vertices, faces, grid, 6)
    nearest = build_tree(cutting.vertices)
    for cut in cuts(cutting, config):
        _, ids = nearest.query(vertices)
        vertices, faces = level_sets.clip(vertices, faces, cut(vertices, cutting.arms[ids]))
        if not len(faces):
            raise AvatarError(f"garment {config.name!r}: the cuts leave nothing; check bottom, top and sleeve.")
    vertices, faces = level_sets.largest_component(vertices, faces)
    vertices, faces = level_sets.compact(vertices, level_sets.drop_ears(faces))
    for _ in range(3):
        vertices, faces = level_sets.collapse_short_edges(vertices, faces, SHORTEST * config.edge)
        faces = level_sets.flip_edges(vertices, faces)
        vertices = level_sets.relax(vertices, faces, grid, 8)
    return Garment(config, lift_off(vertices, cutting.vertices, cutting.faces, config.fabric.thickness), faces)


def garment_field(cutting: Cutting, config: GarmentConfig) -> level_sets.Grid:
    """The signed field whose zero level is the uncut garment: the body with ease, melted into a hanging tube."""
    bottom = cutting.height(config.bottom)
    hip = cutting.height(2 if config.drop is None else config.drop)
    spread = config.flare * (hip - bottom)
    low, high = cutting.vertices.min(0) - PAD - spread, cutting.vertices.max(0) + PAD + spread
    low[1] = bottom - PAD / 2
    axes = [np.arange(low[a], high[a], config.edge) for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    flat = points.reshape(-1, 3)
    reach = 0.1 + max(config.ease, config.sleeve_ease) + (spread if config.drop is None else 0)
    distance = body_distances(cutting.vertices, cutting.faces, flat, reach)
    _, ids = build_tree(cutting.vertices).query(flat)
    ease = config.ease + (config.sleeve_ease - config.ease) * cutting.arms[ids]
    if config.hood:
        ease += HOOD_EASE * cutting.head[ids]
    elif config.drop is None:
        ease += config.flare * np.maximum(hip - flat[:, 1], 0)
    field = distance - ease - crotch_fill(cutting, flat)
    if config.flare and config.drop is None:  # legs stay apart
        apart = np.clip((hip - CROTCH - flat[:, 1]) / CROTCH, 0, 1)
        field = -smooth_minimum(-field, np.abs(flat[:, 0]) + 0.05 - 0.06 * apart, 0.01)
    if config.hood:
        field = smooth_minimum(field, neck_tube(cutting, flat), BLEND)
    if config.drop is not None:
        field = smooth_minimum(field, hanging_tube(cutting, config, flat), BLEND)
    blurred = gaussian_filter(field.reshape(points.shape[:3]), BLUR / config.edge)
    return level_sets.Grid(blurred, low, config.edge)


def crotch_fill(cutting: Cutting, points: np.ndarray) -> np.ndarray:
    """How much to widen the field of ``(N, 3)`` points between the legs, so that trousers bridge the crotch.

    Also keeps the thin gap between the thighs from falling through the grid.
    """
    away = [build_tree(cutting.vertices[cutting.vertices[:, 0] * side > 0]).query(points)[0] for side in (1, -1)]
    mix = np.clip(0.5 + 0.5 * (away[0] - away[1]) / CROTCH, 0, 1)
    below = np.clip((cutting.joints["pelvis"][1] - points[:, 1]) / CROTCH, 0, 1)
    return below * CROTCH * mix * (1 - mix)


def hanging_tube(cutting: Cutting, config: GarmentConfig, points: np.ndarray) -> np.ndarray:
    """Approximate signed distance of ``(N, 3)`` points to cloth hanging straight or flared from the drop level."""
    start, end = cutting.height(config.drop), cutting.height(config.bottom) - PAD
    heights = np.arange(start, end, -0.01)
    feet = cutting.height(0.3) >= heights  # no part of what cloth hangs over
    profile = np.where(feet[:, None], 0, cutting.profile(heights)) * (1, -1, 1)  # so that all three grow downwards
    widest, back, front = np.maximum.accumulate(profile).T * np.array([[1], [-1], [1]])
    spread = config.ease + config.flare * (start - heights)
    at = [np.interp(-points[:, 1], -heights, row) for row in (widest + spread, back - spread, front + spread)]
    half_width, half_depth, centre = at[0], (at[2] - at[1]) / 2, (at[2] + at[1]) / 2
    radius = np.sqrt((points[:, 0] / half_width) ** 2 + ((points[:, 2] - centre) / half_depth) ** 2)
    return np.maximum((radius - 1) * np.minimum(half_width, half_depth), points[:, 1] - start)


def neck_tube(cutting: Cutting, points: np.ndarray) -> np.ndarray:
    """Approximate signed distance of ``(N, 3)`` points to a hood's upright tube, from the shoulders to the jaw."""
    neck, head = cutting.joints["neck"], cutting.joints["head"]
    radius = np.hypot(points[:, 0], points[:, 2] - (neck[2] + head[2]) / 2) - HOOD_NECK
    return np.maximum(radius, np.maximum(neck[1] - 0.03 - points[:, 1], points[:, 1] - head[1] - 0.04))


def smooth_minimum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Minimum of two fields, rounded where they meet (polynomial, Quilez)."""
    mix = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b + (a - b) * mix - width * mix * (1 - mix)


def cuts(cutting: Cutting, config: GarmentConfig) -> list:
    """Functions of ``(vertices, arm weights)`` that are negative where the garment stays, one a cut."""
    bottom = cutting.height(config.bottom)
    made = [lambda v, arm: np.where(arm > 0.5, -1.0, bottom - v[:, 1])]
    if config.top is not None:
        top = cutting.height(config.top)
        return [*made, lambda v, arm: v[:, 1] - top]
    made += [face_opening(cutting)] if config.hood else neckline(cutting, config)
    for side in ("left", "right"):
        chain = np.stack([cutting.joints[f"{side}_{joint}"] for joint in ARM_JOINTS])
        start = min(int(config.sleeve), 1)
        bone = chain[start + 1] - chain[start]
        end, along = chain[start] + (config.sleeve - start) * bone, bone / np.linalg.norm(bone)

        def sleeve(v, arm, end=end, along=along, outward=chain[0, 0]):
            return np.where((arm > 0.5) & (v[:, 0] * outward > 0), (v - end) @ along, -1.0)

        made.append(sleeve)
    if config.opening:
        half, depth = config.opening / 2, cutting.joints["neck"][2]
        made.append(lambda v, arm: np.where((arm < 0.5) & (v[:, 2] > depth), half - np.abs(v[:, 0]), -1.0))
    return made


def face_opening(cutting: Cutting) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The cut of a hood's front: an ellipse from under the chin to the forehead."""
    head, top = cutting.joints["head"], cutting.vertices[:, 1].max()
    middle, half = head[1] + 0.42 * (top - head[1]), 0.52 * (top - head[1])

    def opening(v, arm):
        radius = np.hypot(v[:, 0] / FACE_HALF_WIDTH, (v[:, 1] - middle) / half)
        return np.minimum((1 - radius) * FACE_HALF_WIDTH, v[:, 2] - head[2] - 0.02)

    return opening


def neckline(cutting: Cutting, config: GarmentConfig) -> list:
    """The cuts of a round neck: an upright elliptic cylinder around the neck, a little deeper in front.

    Loose cloth melts into what lies under the chin and would stay on the face: a second cut takes what is left above
    the neck's foot, and what is left in front of the neck above the collarbones.
    """
    neck, head = cutting.joints["neck"], cutting.joints["head"]
    (half, back, _), (_, _, front) = cutting.profile(np.array([(neck[1] + head[1]) / 2, neck[1] - 0.085]))
    back -= max(0.012, config.ease - 0.002)
    half += max(0.018, config.ease + 0.004)
    radii = np.array([half, (front - back) / 2]) + config.neck
    centre = (front + back) / 2

    def round_neck(v, arm):
        radius = np.hypot(v[:, 0] / radii[0], (v[:, 2] - centre) / radii[1])
        return np.where(v[:, 1] > neck[1] - 0.15, (1 - radius) * radii.min(), -1.0)

    def chin(v, arm):
        before = np.minimum(0.8 * radii[0] - np.abs(v[:, 0]), v[:, 2] - centre - 0.6 * radii[1])
        before = np.minimum(before, v[:, 1] - neck[1] + 0.03)
        return np.where(arm < 0.5, np.maximum(before, v[:, 1] - neck[1] - NECK_FOOT), -1.0)

    return [round_neck, chin]
