"""Small training jobs of every kind: a few frames of the embedded sample, networks of some thousand weights."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path
from typing import Any

import torch

from avatar.canonical.canonicalizer import CanonicalizerConfig
from avatar.canonical.fields import SkinningFieldConfig
from avatar.canonical.scans import DrawConfig
from avatar.data.folders import SAMPLE_FOLDER
from avatar.data.scanner import ScanConfig
from avatar.data.splits import SplitConfig
from avatar.io.frames import write_manifest
from avatar.methods.canonicalizer import CanonicalizeConfig, CycleConfig, WeightSource
from avatar.methods.settings import MethodChoice, RunConfig, TrainConfig
from avatar.runs.canonicalizing import canonicalize_frames, train_canonicalizer
from avatar.runs.training import train

DATASET, OUTFIT = "open", "tee"
STEPS, SAVE_EVERY = 24, 4
FRAMES = {"train": 4, "test": 2}
HIERARCHY = {"points": [96, 24], "radii": [0.3, 1.0], "neighbours": 8}
DECODER = {"width": 16, "trunk": 2, "branch": 0}
CLOSET = {
    "pose_encoder": {"hierarchy": HIERARCHY, "abstraction": [[8], [16]], "propagation": [[16], [8]]},
    "garment_encoder": {"hierarchy": HIERARCHY, "abstraction": [[8], [16]], "propagation": [[16], [8]]},
    "garment_decoder": DECODER,
    "pose_decoder": DECODER,
    "code_channels": 4,
    "pose_noise": 0.01,  # draws from the random state that a resumed run must have back
}
POP = {
    "pose_encoder": {"levels": 3, "width": 4, "out_channels": 8},
    "pose_decoder": DECODER,
    "garment_decoder": DECODER,
    "map_size": 16,
    "code_channels": 4,
}
SCANIMATE = {
    "avatar": {"sdf": {"widths": [16, 16, 16], "skip": 1, "orders": 2}, "gate_spacing": 0.1},
    "train": {"queries": {"near_points": 60, "box_points": 30, "boundary_points": 20}},
}
SETTINGS: dict[str, dict[str, Any]] = {"closet": CLOSET, "pop": POP, "scanimate": SCANIMATE}
JOBS = ("closet", "pop", "canonicalizer", "scanimate")


def write_data(root: Path) -> Path:
    """Copies a few frames of the embedded outfit to ``<root>/data/open/tee``, and brings its scans to the T-pose.

    Returns:
        The outfit's folder.
    """
    folder = root / "data" / DATASET / OUTFIT
    if not (folder / "manifest.json").is_file():
        source = SAMPLE_FOLDER / OUTFIT
        for split, count in FRAMES.items():
            (folder / split).mkdir(parents=True, exist_ok=True)
            for path in sorted((source / split).glob("*.npz"))[:count]:
                shutil.copyfile(path, folder / split / path.name)
        for name in ("garment.npz", "outfit.yaml"):
            shutil.copyfile(source / name, folder / name)
        write_manifest(folder)
    return folder


def canonicalizer_config(
    root: Path, name: str = "default", weights: WeightSource = WeightSource.learned
) -> CanonicalizeConfig:
    """A canonicalizer of two stages."""
    field = SkinningFieldConfig(width=8)
    return CanonicalizeConfig(
        dataset=DATASET,
        outfit=OUTFIT,
        name=name,
        data_root=root / "data",
        runs_root=root / "runs",
        weights=weights,
        scan=ScanConfig(points=1000),
        canonicalizer=CanonicalizerConfig(field, SkinningFieldConfig(width=8, orders=8, latent=4)),
        train=CycleConfig(
            first_steps=STEPS // 2,
            second_steps=STEPS // 2,
            batch=2,
            draw=DrawConfig(scan=60, body=40, edges=20, pool=500),
            code_steps=2,
            save_every=SAVE_EVERY,
            log_every=1,
        ),
        device="cpu",
    )


def run_config(job: str, root: Path, name: str = "default", **options: Any) -> RunConfig:
    """A run of closet, pop or scanimate; ``options`` go to its training."""
    training = {"steps": STEPS, "batch": 2, "points": 300, "scan_points": 300, "fresh_points": True, "lr": 1e-3}
    training |= {"save_every": SAVE_EVERY, "validate_every": 2 * SAVE_EVERY, "log_every": 1}
    return RunConfig(
        method=MethodChoice(job, job, SETTINGS[job]),
        dataset=DATASET,
        outfit=(OUTFIT,),
        name=name,
        data_root=root / "data",
        runs_root=root / "runs",
        scan=ScanConfig(points=1000),
        split=SplitConfig(validation_share=0.25),
        canonical="nearest",
        train=TrainConfig(**(training | options)),
        device="cpu",
    )


def prepare(root: Path) -> None:
    """Data, and the canonical scans that `scanimate` is trained on."""
    write_data(root)
    torch.set_num_threads(1)
    config = canonicalizer_config(root, "nearest", WeightSource.nearest)
    train_canonicalizer(config)
    canonicalize_frames(config)


def folder_of(job: str, root: Path, name: str = "default") -> Path:
    """Run folder of a job."""
    config = canonicalizer_config(root, name) if job == "canonicalizer" else run_config(job, root, name)
    return config.folder


def train_job(job: str, root: Path, name: str = "default", **options: Any) -> Path:
    """Trains a job to its end, or resumes it, on one thread; returns the run's folder."""
    torch.set_num_threads(1)
    if job == "canonicalizer":
        return train_canonicalizer(canonicalizer_config(root, name))
    return train(run_config(job, root, name, **options))


def weights_digest(folder: Path) -> str:
    """SHA-256 of a finished run's weights file; empty for a run that is not finished."""
    paths = list(folder.glob("*.safetensors"))
    return hashlib.sha256(paths[0].read_bytes()).hexdigest() if len(paths) == 1 else ""
