"""Priors of poses: Gaussians over the axis-angles of joints, from drawn poses within human limits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from avatar.simulate.angles import EVERYDAY, everyday_angles, pose_from_angles
from avatar.simulate.poses import random_angles

DRAWN = 2048  # poses of either kind


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian over the pose numbers of all joints but the root: ``mean (3 (J - 1),)`` and ``precision``."""

    mean: Tensor
    precision: Tensor


@cache
def drawn_prior(slack: float) -> PosePrior:
    """The prior of everyday and random poses, which the open dataset's training frames are drawn from as well.

    No authored motion, which are what it is tested on, takes part. ``slack`` radians, a standard deviation, are added
    for every number: drawn joints turn about few axes, and people's about all.
    """
    share = DRAWN // len(EVERYDAY)
    count = 1 << (share - 1).bit_length()  # draws are balanced at powers of two
    poses = [pose_from_angles(everyday_angles(name, count, seed=7), count) for name in EVERYDAY]
    poses.append(pose_from_angles(random_angles(DRAWN, 7), DRAWN))
    flat = np.concatenate(poses)[:, 1:].reshape(-1, 63).astype(np.float64)
    covariance = np.cov(flat.T) + slack**2 * np.eye(63)
    return PosePrior(torch.from_numpy(flat.mean(axis=0)).float(), torch.from_numpy(np.linalg.inv(covariance)).float())
