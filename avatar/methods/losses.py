"""What point avatars are trained on: Chamfer, normals and regularisers, each a named and weighted term."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from torch import Tensor

from avatar.checks import AvatarError
from avatar.geometry.neighbours import correspond, normal_difference, point_to_plane, point_to_point
from avatar.geometry.sparse import gather_rows
from avatar.records import Batch, LossTerms, Prediction

TERMS = ("scan_to_points", "points_to_scan", "normal", "offset", "wrinkle", "wrinkle_normal", "code")


class Chamfer(Enum):
    """The prediction-to-scan half of the Chamfer term."""

    point = "point"  # CloSET eq. 4
    plane = "plane"  # POP


@dataclass
class LossConfig:
    """Weights of the point avatars' loss terms; metres. POP's numbers, from which CloSET's own are not known."""

    chamfer: Chamfer = Chamfer.point
    scan_to_points: float = 1e4
    points_to_scan: float = 1e4
    normal: float = 1.0
    normal_start: float = 0.6  # share of training before which there is no normal term (POP: epoch 250 of 400)
    offset: float = 2e3  # mean |r|^2
    wrinkle: float = 0.0  # mean |r^p|^2; what all poses share then moves into the garment template
    wrinkle_normal: float = 0.0  # the same for what the pose adds to the normals
    code: float = 1.0  # mean square of the garment codes

    def __post_init__(self):
        weights = {key: value for key, value in vars(self).items() if key != "chamfer"}
        wrong = {key: value for key, value in weights.items() if value < 0}
        if wrong or not 0 <= self.normal_start <= 1:
            raise AvatarError(f"loss: expected weights of at least 0, normal_start in [0, 1], got {wrong or weights}.")


def point_avatar_loss(prediction: Prediction, batch: Batch, config: LossConfig, progress: float) -> LossTerms:
    """CloSET's objective (eqs. 4-6): L = lp Lp + ln Ln + lrgl Lrgl, every part named.

    Means over points and frames: square metres for distances, L1 of unit normals (mean over the three components, as
    in POP). ``progress`` is the share of training that is done, in [0, 1]; before ``normal_start`` the normal term has
    no gradient at all, for Adam makes full steps of any factor, however small.
    """
    found = correspond(prediction.points.detach(), batch.scan_points)
    anchors = gather_rows(batch.scan_points, found.scan_of_point)
    anchor_normals = gather_rows(batch.scan_normals, found.scan_of_point)
    if config.chamfer is Chamfer.plane:
        to_scan = point_to_plane(prediction.points, anchors, anchor_normals)
    else:
        to_scan = point_to_point(prediction.points, anchors)
    to_points = point_to_point(batch.scan_points, gather_rows(prediction.points, found.point_of_scan))
    raw = {
        "scan_to_points": to_points.mean(),
        "points_to_scan": to_scan.mean(),
        "normal": normal_difference(prediction.normals, anchor_normals).mean() / 3,
        "offset": squared_norm(prediction.offsets),
    }
    if prediction.wrinkle_offsets is not None:
        raw["wrinkle"] = squared_norm(prediction.wrinkle_offsets)
    if prediction.wrinkle_normals is not None:
        raw["wrinkle_normal"] = squared_norm(prediction.wrinkle_normals)
    if prediction.codes is not None:
        raw["code"] = prediction.codes.square().mean()
    weights = {name: getattr(config, name) for name in raw}
    if progress < config.normal_start:
        weights["normal"] = 0.0
    return LossTerms(raw, {name: value * weights[name] for name, value in raw.items() if weights[name]})


def squared_norm(offsets: Tensor) -> Tensor:
    """Mean squared length of vectors ``(..., 3)``: of offsets in square metres (CloSET eq. 6)."""
    return offsets.square().sum(dim=-1).mean()
