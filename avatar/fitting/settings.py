"""Settings of the registration of bodies to scans."""

from __future__ import annotations

from dataclasses import dataclass, field

from avatar.checks import AvatarError, check_range


@dataclass
class StageConfig:
    """One stage of the registration, coarse to fine."""

    points: int = 1000  # samples of the scan and of the body
    steps: int = 15  # Gauss-Newton steps, each with new correspondences
    kept: int = 1  # starts that go on to the next stage, those of the least objective
    reach: float = 0.1  # m, distances well beyond count little (scale of Geman and McClure's loss)
    cloth: float = 0.05  # m, the same outside the skin, where cloth may lie between
    sigma: float = 0.02  # m, a distance that weighs as much as one standard deviation of the priors

    def __post_init__(self):
        check_range(self, "points", "kept", low=1)
        check_range(self, "steps", low=0)
        check_range(self, "reach", "cloth", "sigma", above=0, high=1)


STAGES = (  # coarse with all starts, then the best few, then one
    StageConfig(points=300, steps=12, kept=6, reach=0.3, cloth=0.3, sigma=0.05),
    StageConfig(points=600, steps=10, kept=2, reach=0.1, cloth=0.1, sigma=0.03),
    StageConfig(points=1500, steps=12, kept=1, reach=0.05, cloth=0.03, sigma=0.02),
    StageConfig(points=4000, steps=10, kept=1, reach=0.03, cloth=0.015, sigma=0.01),
)


@dataclass
class QualityConfig:
    """What a frame's fit must reach, or it is reported as failed.

    The limits lie between what right fits and fits forced to a wrong heading reach on raw scans of the open data
    (docs/fitting.md). Hair and shoes lie outside the skin: people who wear them need a larger ``bare``.
    """

    inside: float = 0.015  # largest share of the scan's points more than 1 cm inside the body
    bare: float = 0.006  # m, largest median distance of the scan from the bare skin of head, hands and feet
    covered: float = 0.9  # least share of the body with the scan near or over it
    objective: float = 230.0  # largest objective of the last stage, in the priors' squared standard deviations

    def __post_init__(self):
        check_range(self, "inside", "bare", "covered", "objective", low=0)


@dataclass
class FittingConfig:
    """How bodies are fitted to scans."""

    clothing: bool = True  # cloth may lie outside the skin; false: the scan is the skin itself, both sides cost alike
    sequence: bool = False  # scans follow each other in time: each fit starts from the one before
    shape_frames: int = 8  # scans, spread over all, that a subject's one shape is estimated from
    headings: int = 8  # turns about the vertical that a fit starts from
    stages: list[StageConfig] = field(default_factory=lambda: list(STAGES))  # coarse to fine
    effective: float = 300.0  # independent distances that the samples of a scan are worth against the priors
    outside: float = 0.3  # weight of cloth outside the skin, against skin outside the scan
    tangential: float = 0.1  # share of distances along the surface in the squared distances
    normal_reach: float = 0.1  # m, what unit difference of normals counts as in the search for correspondences
    slack: float = 0.1  # rad, standard deviation that the pose prior grants beyond drawn poses
    tilt: float = 0.3  # rad, standard deviation of the pelvis's tilt
    damping: float = 1.0  # added to the normal equations' diagonal, in the priors' precision
    longest_step: float = 0.4  # rad and m, longer steps are shortened
    least_points: int = 2000  # of a scan; fewer are refused
    seed: int = 0  # of the scan's samples
    quality: QualityConfig = field(default_factory=QualityConfig)

    def __post_init__(self):
        if not self.stages:
            raise AvatarError("stages: expected at least one, got none.")
        check_range(self, "headings", "shape_frames", "least_points", low=1)
        check_range(self, "effective", "slack", "tilt", "longest_step", above=0)
        check_range(self, "outside", "tangential", low=0, high=1)
        check_range(self, "normal_reach", "damping", low=0)
