"""One subject: a shape for all scans and a pose for each, resumable scan by scan."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from avatar.body.families import BodyFamily
from avatar.body.model import BodyModel
from avatar.checks import AvatarError
from avatar.fitting.matching import BARE, Registration, ScanSamples, check_scan, prepare_samples
from avatar.fitting.posing import Fit, PosedFamily, join_fits
from avatar.fitting.quality import FitQuality, measure_fit
from avatar.fitting.settings import FittingConfig
from avatar.io.ledger import Ledger, digest_of, keyed
from avatar.progress import tracked
from avatar.records import PointCloud

SOURCE = ("avatar.fitting.subjects",)  # with what it imports: the code that a fit depends on
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameFit:
    """The body under one scan: ``pose (22, 3)`` axis-angle relative to the T-pose, radians; ``translation (3,)`` m."""

    name: str
    pose: np.ndarray
    translation: np.ndarray
    quality: FitQuality
    failed: str = ""  # the reasons, empty for a good fit

    @property
    def heading(self) -> float:
        """Where the pelvis looks, radians about the vertical from +z towards +x."""
        ahead = Rotation.from_rotvec(self.pose[0]).apply([0, 0, 1])
        return float(np.arctan2(ahead[0], ahead[2]))


@dataclass(frozen=True)
class SubjectFit:
    """One subject's body and its pose in every scan."""

    shape: dict[str, float]  # parameters of the family, by name
    body: BodyModel
    frames: tuple[FrameFit, ...]

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the scans whose fits failed."""
        return tuple(frame.name for frame in self.frames if frame.failed)


@torch.no_grad()
def fit_subject(
    scans: Sequence[PointCloud],
    family: BodyFamily,
    config: FittingConfig,
    names: Sequence[str] = (),
    minimal: Sequence[int] = (),
    shape: Sequence[float] | None = None,
    ledger: Ledger | None = None,
    progress: bool = True,
) -> SubjectFit:
    """Fits one shape, and a pose and place for each scan, to oriented points in metres, y up, of any heading.

    The shape comes from the scans numbered ``minimal``, in minimal clothing, where there are any (their scans are
    taken for skin, as CloSET's authors did), else from `FittingConfig.shape_frames` of all scans, together; a
    ``shape (K,)`` given is kept. Scans may be read when they are asked for (a `Sequence` that loads them). With a
    ``ledger``, finished scans are kept in it and not fitted again: the same bits as in one go.

    Raises `AvatarError`, with the figure, for no scans, NaN, too few points, another unit than metres, or names,
    numbers or shapes that do not fit.
    """
    names = tuple(names) or tuple(f"scan.{i:05d}" for i in range(len(scans)))
    if not len(scans) or len(names) != len(scans):
        raise AvatarError(f"scans: expected at least one and a name for each, got {len(scans)} and {len(names)} names.")
    if any(not 0 <= i < len(scans) for i in minimal):
        raise AvatarError(f"minimal: expected numbers of scans below {len(scans)}, got {list(minimal)}.")
    if shape is not None and len(shape) != len(family.names):
        raise AvatarError(f"shape: expected {len(family.names)} parameters, got {len(shape)}.")
    subject = Subject(scans, names, family, config, ledger, progress)
    body_shape = torch.tensor(shape, dtype=torch.float32) if shape is not None else subject.estimate_shape(minimal)
    return subject.fit_poses(body_shape)


class Subject:
    """The work on one subject: what `fit_subject` keeps between its two parts."""

    def __init__(
        self,
        scans: Sequence[PointCloud],
        names: Sequence[str],
        family: BodyFamily,
        config: FittingConfig,
        ledger: Ledger | None,
        progress: bool,
    ):
        self.scans, self.names, self.family, self.config = scans, names, family, config
        self.ledger, self.progress = ledger, progress
        self.matcher = Registration(family, config)
        self.known: dict[int, Fit] = {}  # of the scans that the shape was estimated from, each in its own shape
        self.key = keyed(SOURCE, config=asdict(config), family=family_digest(family))
        bare = [family.bind.joint_names.index(name) for name in BARE]
        self.bare = (family.bind.weights[:, bare].sum(dim=1) > 0.5).numpy()

    def load(self, number: int) -> tuple[PointCloud, ScanSamples]:
        """A scan, checked, and its samples."""
        cloud = self.scans[number]
        check_scan(cloud, self.config, self.names[number])
        return cloud, prepare_samples(cloud, self.config)

    def estimate_shape(self, minimal: Sequence[int]) -> torch.Tensor:
        """The one shape ``(K,)`` of the scans in minimal clothing, or of some spread over all."""
        if not self.family.names:
            return self.family.mean
        count = min(self.config.shape_frames, len(self.scans))
        numbers = list(minimal) or np.linspace(0, len(self.scans) - 1, count).round().astype(int).tolist()
        clothing = self.config.clothing and not minimal
        matcher = Registration(self.family, replace(self.config, clothing=clothing))
        fits, kept, costs, prints = [], [], [], []
        for number in tracked(numbers, "fit the shape", "scan", silent=not self.progress):
            cloud, samples = self.load(number)
            prints.append(cloud_digest(cloud))
            made_of = {"clothing": clothing, "scan": prints[-1]}
            fit, cost = self._once(f"start/{self.names[number]}", made_of, partial(matcher.fit_one, samples))
            fits.append(fit)
            self.known[number] = fit
            kept.append(samples)
            costs.append(cost)
        good = [i for i, cost in enumerate(costs) if cost <= 2 * float(np.median(costs))]
        made_of = {"clothing": clothing, "scans": prints, "numbers": numbers}
        scans, starts = [kept[i] for i in good], join_fits([fits[i] for i in good])
        fit, _ = self._once("shape", made_of, lambda: (matcher.fit_shape(scans, starts)[:1], 0.0))
        return fit.shape[0]

    def fit_poses(self, shape: torch.Tensor) -> SubjectFit:
        """The pose and place of every scan in one shape, measured."""
        body = self.family.body(shape)
        frames: list[FrameFit] = []
        previous: Fit | None = None
        for number in tracked(range(len(self.scans)), "fit bodies", "scan", silent=not self.progress):
            cloud, samples = self.load(number)
            start = self.known.get(number) if previous is None else previous
            start = start and Fit(start.pose, start.translation, shape[None])
            made_of = {"shape": shape.tolist(), "scan": cloud_digest(cloud), "start": start and start.pose.tolist()}
            found, objective = self._once(
                f"pose/{self.names[number]}", made_of, partial(self._fit_pose, samples, cloud, shape, start)
            )
            frame = self._measured(self.names[number], cloud, found, objective)
            if frame.failed:
                log.warning("%s: the fit failed: %s.", frame.name, frame.failed)
            frames.append(frame)
            previous = found if self.config.sequence and not frame.failed else None
        return SubjectFit(dict(zip(self.family.names, shape.tolist())), body, tuple(frames))

    def _fit_pose(
        self, samples: ScanSamples, cloud: PointCloud, shape: torch.Tensor, start: Fit | None
    ) -> tuple[Fit, float]:
        """The fit from a start, or from all of them where there is none or it leads nowhere."""
        if start is not None:
            found = self.matcher.fit_one(samples, shape, start)
            if not self._measured("", cloud, *found).failed:
                return found
        return self.matcher.fit_one(samples, shape)

    def _measured(self, name: str, cloud: PointCloud, fit: Fit, objective: float) -> FrameFit:
        """A fit with its quality."""
        posed = PosedFamily(self.family, fit)
        vertices, normals = posed.points()[0].double().numpy(), posed.normals(self.family.normals)[0].numpy()
        quality = measure_fit(cloud, vertices, normals, self.family.bind.faces.numpy(), self.bare, objective)
        reasons = "; ".join(quality.failures(self.config.quality))
        return FrameFit(name, fit.pose[0].numpy(), fit.translation[0].numpy(), quality, reasons)

    def _once(self, name: str, made_of: dict[str, Any], fit: Callable[[], tuple[Fit, float]]) -> tuple[Fit, float]:
        """A fit of one body with its objective: the ledger's, or a new one."""
        key = digest_of([self.key, made_of])
        note = self.ledger.find(name, key) if self.ledger is not None else None
        if note is None:
            found, objective = fit()
            note = {part: getattr(found, part)[0].tolist() for part in ("pose", "translation", "shape")}
            note["objective"] = objective
            if self.ledger is not None:
                self.ledger.record(name, key, note=note)
        parts = (torch.tensor([note[part]], dtype=torch.float32) for part in ("pose", "translation", "shape"))
        return Fit(*parts), note["objective"]


def cloud_digest(cloud: PointCloud) -> str:
    """The sha256 of a scan's points and normals."""
    digest = hashlib.sha256()
    for array in (cloud.points, cloud.normals):
        digest.update(np.ascontiguousarray(array, np.float32).tobytes())
    return digest.hexdigest()


def family_digest(family: BodyFamily) -> str:
    """A hash over what a fit depends on in a family: its kind, prior, bounds and mean body."""
    vertices, joints = family.rest(family.mean[None])
    parts = (vertices, joints, family.mean, family.std, family.low, family.high, family.bind.weights)
    return digest_of([family.kind, *(hashlib.sha256(part.numpy().tobytes()).hexdigest() for part in parts)])
