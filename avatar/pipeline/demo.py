"""`demo`: the main job from data to report on the embedded sample, in a few minutes on two cores."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from avatar.checks import AvatarError
from avatar.environment import prepared_process
from avatar.evaluation.scoring import ScoreConfig
from avatar.export.meshing import require_poisson
from avatar.export.pictures import load_pyvista
from avatar.io.npz import write_whole
from avatar.methods.canonicalizer import CanonicalizeConfig
from avatar.methods.points import check_count
from avatar.methods.registry import find_method
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.pipeline.canonicalization import canonicalize
from avatar.pipeline.reporting import ReportConfig, report
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict
from avatar.pipeline.surfaces import MeshConfig, mesh
from avatar.runs.training import train

log = logging.getLogger(__name__)


@dataclass
class DemoConfig(RunConfig):
    """The main job: canonicalize, train an avatar and its static floor, predict, score, mesh and report."""

    canonicalizer: CanonicalizeConfig = field(default_factory=CanonicalizeConfig)  # its data and name are the run's
    static_share: float = 0.4  # of the training minutes, spent on the static floor
    points: int = 50000  # predicted a frame
    meshes: int = 4  # frames meshed
    score: ScoreConfig = field(default_factory=ScoreConfig)

    def __post_init__(self):
        super().__post_init__()
        check_count(self.points)
        if find_method(self.method.name).static is None:
            raise AvatarError(
                f"method: expected one with a static floor (CloSET or one of its variants), got {self.method.name}. "
                f"Hint: train others by tools/train.py method={self.method.variant}."
            )


@prepared_process()
def demo(config: DemoConfig) -> Path:
    """Runs the main job; gives ``<runs>/demo/summary.json``, which says what was made and how long each stage took.

    Raises:
        AvatarError: before any work, without test frames, and on a machine that cannot mesh or draw.
    """
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        log.info("demo: %s", name)
        started = time.monotonic()
        yield
        seconds[name] = round(time.monotonic() - started, 1)

    settings = RunConfig(**{f.name: getattr(config, f.name) for f in fields(RunConfig)})
    budget = replace(settings.train, minutes=(settings.train.minutes or 2.0) * config.static_share)
    name = settings.method.name
    static = MethodChoice(name, "static", settings.method.settings | dict(find_method(name).static))
    where = {key: getattr(settings, key) for key in ("dataset", "data_root", "runs_root", "device")}
    for outfit in settings.outfits():
        outfit.frames("test")
    require_poisson()
    load_pyvista()
    with stage("canonicalize"):
        canonicalized = [
            canonicalize(replace(config.canonicalizer, outfit=outfit, name=settings.canonical, **where))
            for outfit in settings.outfit
        ]
    with stage("train"):
        run = train(settings)
    with stage("train static floor"):
        floor = train(replace(settings, method=static, train=budget))
    with stage("predict"):
        folders = [path for folder in (run, floor) for path in predict(PredictConfig(run=folder, points=config.points))]
    with stage("evaluate"):
        scores = evaluate(EvaluateConfig(runs=(floor, run), score=config.score))
    with stage("mesh"):
        meshes = list(mesh(MeshConfig(run=run, frames=config.meshes)))
    with stage("report"):
        page = report(ReportConfig(run=run, against=(floor,)))
    summary = {
        "seconds": seconds | {"total": round(sum(seconds.values()), 1)},
        "metrics": [
            {"outfit": row.outfit, "method": row.method, "metric": row.metric, "value": row.value, "unit": row.unit}
            for row in scores.rows
        ],
        "made": {
            "report": str(page),
            "canonical scans": [str(folder / "scans") for folder in canonicalized],
            "points": [str(path) for path in folders],
            "meshes": [str(path) for path in meshes],
            "weights": str(run / "avatar.safetensors"),
        },
    }
    path = config.runs_root / "demo" / "summary.json"
    write_whole(path, json.dumps(summary, indent=1).encode())
    return path
