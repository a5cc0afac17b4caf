"""Settings of the registration of bodies to scans."""

from __future__ import annotations

from dataclasses import dataclass, field

from avatar.checks import AvatarError, check_range


@dataclass
class StageConfig:
    """One stage of the registration, coarse to fine."""

    points: int = 1000  # samples of the scan and of the body
    steps: int = 15  # Gauss-Newton steps, each with new correspondences
    kept: int = 1  # starts that go on, those of the least objective
    reach: float = 0.1  # m; distances well beyond count little (scale of Geman and McClure's loss)
    cloth: float = 0.05  # m; the same outside the skin, where cloth may lie between
    sigma: float = 0.02  # m; a distance that weighs as much as one standard deviation of the priors


def default_stages() -> list[StageConfig]:
    """Coarse with all starts, then the best few, then one."""
    return [
        StageConfig(points=300, steps=12, kept=6, reach=0.3, cloth=0.3, sigma=0.05),
        StageConfig(points=600, steps=10, kept=2, reach=0.1, cloth=0.1, sigma=0.03),
        StageConfig(points=1500, steps=12, kept=1, reach=0.05, cloth=0.03, sigma=0.02),
        StageConfig(points=4000, steps=10, kept=1, reach=0.03, cloth=0.015, sigma=0.01),
    ]


@dataclass
class FittingConfig:
    """How bodies are fitted to scans."""

    clothing: bool = True  # cloth may lie outside the skin; false: the scan is the skin itself, both sides cost alike
    headings: int = 8  # turns about the vertical that a fit starts from
    stages: list[StageConfig] = field(default_factory=default_stages)
    effective: float = 300.0  # independent distances that the samples of a scan are worth against the priors
    inside: float = 1.0  # weight of skin outside the scan
    outside: float = 0.3  # weight of cloth outside the skin, against the same distance the other way
    tangential: float = 0.1  # weight of distances along the surface, against those across it
    normal_reach: float = 0.1  # m; what a turn of normals by a radian counts as in the search for correspondences
    slack: float = 0.1  # rad; standard deviation that the pose prior grants beyond drawn poses
    pose_weight: float = 1.0  # of the pose prior
    shape_weight: float = 1.0  # of the shape prior
    tilt: float = 0.3  # rad; standard deviation of the pelvis's tilt
    damping: float = 1.0  # added to the normal equations' diagonal, in units of the priors' precision
    longest_step: float = 0.4  # rad and m; longer steps are shortened
    shape_frames: int = 8  # scans that a subject's one shape is estimated from
    seed: int = 0  # of the samples

    def __post_init__(self):
        if self.headings < 1 or not self.stages:
            raise AvatarError(f"headings, stages: expected at least 1, got {self.headings} and {len(self.stages)}.")
        check_range(self, "effective", "sigma_floor" if hasattr(self, "sigma_floor") else "tilt", above=0)
