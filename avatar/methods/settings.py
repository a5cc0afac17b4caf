"""Settings of a training run: budget and optimiser, data, method, and where its folder is."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from avatar.checks import AvatarError, check_name
from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.data.scanner import ScanConfig
from avatar.data.splits import SplitConfig
from avatar.methods.losses import LossConfig

MAX_FOLDER = 200  # letters of a folder's name; file systems take 255
CANONICALIZERS = "canonical"  # the folder of canonicalizers' runs, beside those of the methods


class Schedule(Enum):
    """How the learning rate moves over training."""

    constant = "constant"  # POP
    cosine = "cosine"  # falls to a hundredth


class Clock(Enum):
    """Clock that `minutes` of a budget are read from."""

    wall = "wall"
    processor = "processor"  # of all threads of a process together: fair to jobs that share a machine

    def seconds(self) -> float:
        """Seconds since some moment."""
        return time.process_time() if self is Clock.processor else time.monotonic()


class Precision(Enum):
    """Arithmetic of the network's forward pass; positions, distances and losses are always float32."""

    fp32 = "fp32"
    bf16 = "bf16"


@dataclass
class TrainConfig:
    """Budget, optimiser and bookkeeping of one training run."""

    steps: int = 20000  # optimiser steps; the schedule's end unless minutes says otherwise
    minutes: float | None = None  # budget of time; training ends at whichever comes first
    clock: Clock = Clock.wall  # that minutes are read from
    batch: int = 4  # frames a step
    points: int = 50000  # template points predicted for each frame
    fresh_points: bool = False  # draw new template points every step, instead of one fixed set
    mirror: bool = False  # show half of the frames mirrored: for symmetric clothes, twice the poses
    scan_points: int = 40000  # scan points a frame, drawn anew every epoch from those there are
    lr: float = 3e-4  # networks
    code_lr: float = 5e-4  # garment codes
    schedule: Schedule = Schedule.constant
    warmup: int = 0  # steps over which the learning rate rises from zero
    clip: float | None = None  # largest gradient norm
    precision: Precision = Precision.fp32
    validate_every: int = 500  # steps
    save_every: int = 500  # steps
    log_every: int = 20  # steps
    seed: int = 0
    loss: LossConfig = field(default_factory=LossConfig)

    def __post_init__(self):
        for name in ("steps", "batch", "points", "scan_points", "validate_every", "save_every", "log_every"):
            if getattr(self, name) < 1:
                raise AvatarError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if self.lr <= 0 or self.code_lr <= 0 or self.warmup < 0:
            raise AvatarError("lr, code_lr: expected above 0; warmup: at least 0.")
        if (self.minutes is not None and self.minutes <= 0) or (self.clip is not None and self.clip <= 0):
            raise AvatarError(f"minutes, clip: expected above 0 or null, got {self.minutes} and {self.clip}.")

    def rate_factor(self, step: int, progress: float) -> float:
        """The learning rate's factor at a step, with a share of the budget spent: warm-up, then the schedule."""
        rise = min(1.0, (step + 1) / self.warmup) if self.warmup else 1.0
        if self.schedule is Schedule.cosine:
            return rise * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))
        return rise


class Space(Enum):
    """Where an avatar is compared with its scans in training; it predicts posed surfaces either way."""

    posed = "posed"  # CloSET: with the scans as they are
    canonical = "canonical"  # with the T-pose scans of the outfits' canonicalizers


@dataclass
class MethodChoice:
    """A method by name; ``variant`` names the run's folder, ``settings`` are the method's own options."""

    name: str = "closet"
    variant: str = "closet"
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass
class RunConfig:
    """One training run: what to train, on which outfits, where."""

    method: MethodChoice = field(default_factory=MethodChoice)
    dataset: str = "sample"
    outfit: tuple[str, ...] = ("dress",)  # several train one network with a garment code each
    name: str = "default"
    data_root: Path = Path("data")
    runs_root: Path = Path("runs")
    scan: ScanConfig = field(default_factory=ScanConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    space: Space = Space.posed  # of the run, not the method: the network is the same
    canonical: str = "default"  # name of the canonicalizers' runs, for space=canonical and learned skinning
    train: TrainConfig = field(default_factory=TrainConfig)
    device: str = "auto"  # auto takes CUDA where there is one
    spent: float = 0.0  # seconds spent for the run before its training (an experiment's front end); tables add them

    def __post_init__(self):
        names = {"name": self.name, "method.variant": self.method.variant, "canonical": self.canonical}
        for what, value in (names | {"dataset": self.dataset}).items():
            check_name(what, value)
        if self.method.variant == CANONICALIZERS:
            raise AvatarError(f"method.variant: {CANONICALIZERS!r} is where canonicalizers are. Choose another name.")
        if not self.outfit or len(set(self.outfit)) != len(self.outfit):
            raise AvatarError(f"outfit: expected one or more different outfits, got {self.outfit}.")
        for name in self.outfit:
            check_name("outfit", name)
        if len(self.folder.parent.name) > MAX_FOLDER:
            raise AvatarError(f"outfit: expected outfits whose names together have at most {MAX_FOLDER} letters.")

    @property
    def folder(self) -> Path:
        """Where the run lives: ``<runs>/<variant>/<dataset>/<outfit>/<name>``."""
        return self.runs_root / self.method.variant / self.dataset / "+".join(self.outfit) / self.name

    def outfits(self) -> list[Outfit]:
        """The run's outfits on disk."""
        return [find_outfit(self.data_root, self.dataset, name, self.scan) for name in self.outfit]


@dataclass
class FitConfig:
    """Fitting an outfit that a network has not seen, from its first training scan or any other one frame."""

    run: Path = Path("runs/closet/open/several/default")
    dataset: str = "open"
    outfit: str = "skirt"
    frame: str | None = None  # the scan to fit; the first training frame if null
    data_root: Path = Path("data")
    runs_root: Path = Path("runs")
    name: str = "fitted"
    steps: int = 401  # POP
    code_lr: float = 5e-4  # POP; divided by ten for the second half
    points: int = 50000  # template points predicted
    scan_points: int = 40000
    seed: int = 0
    loss: LossConfig = field(default_factory=lambda: LossConfig(normal_start=0.0))
    device: str = "auto"

    def __post_init__(self):
        for what in ("name", "dataset", "outfit"):
            check_name(what, getattr(self, what))
        if self.steps < 1 or self.code_lr <= 0:
            raise AvatarError(f"steps, code_lr: expected positive values, got {self.steps} and {self.code_lr}.")
