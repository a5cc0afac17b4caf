"""Canonicalizers' runs: trained into their folder, and the canonical scans of an outfit's frames written there."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch

from avatar.body.packed import write_template
from avatar.canonical.canonicalizer import Canonicalizer
from avatar.canonical.fields import KNN, BodyField
from avatar.canonical.scans import canonicalize_scan, prepare_scan
from avatar.checks import DataError
from avatar.data.batches import FrameDataset, LruSequence
from avatar.data.validation import check_frame_count
from avatar.environment import choose_device, prepared_process
from avatar.io.checkpoints import read_weights, write_weights
from avatar.io.frames import write_canonical_scan
from avatar.io.ledger import Ledger, digest_of, file_digest, keyed, module_digest
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.methods import canonicalizer
from avatar.methods.canonicalizer import CanonicalizeConfig, SkinningSource, WeightSource
from avatar.progress import tracked
from avatar.records import Mesh, PointCloud, Template
from avatar.runs.training import save_settings
from avatar.settings import settings_to_dict
from avatar.training.trainer import Trainer, spent
from avatar.world import require_single_process

# What makes canonical scans of trained weights, beside this module; how these were trained shows in the weights.
SOURCE = ("avatar.canonical.scans", "avatar.methods.canonicalizer", "avatar.data.layouts")


@prepared_process()
def train_canonicalizer(config: CanonicalizeConfig, frames: FrameDataset | None = None) -> Path:
    """Trains a run's canonicalizer, or goes on with it; gives the run's folder. Baselines have nothing to learn.

    ``frames`` are the run's, where the caller has them already. Raises `AvatarError` when the folder holds a run with
    other settings, or training fails.
    """
    require_single_process("canonicalizer")
    frames = frames or config.frames()
    template = frames.outfits[0].template
    save_settings(config)
    write_template(config.folder / "template.npz", template)
    if config.weights is not WeightSource.learned or is_trained(config):
        return config.folder
    learned = [index for index, where in enumerate(frames.names) if where.split == "train"]
    names = [frames.names[index].name for index in learned]
    check_frame_count(names, frames.outfits[0].path / "train", "the canonicalizer")
    prepare = partial(prepare_scan, template=template, pool=config.train.draw.pool, seed=config.train.seed)
    scans = LruSequence(lambda place: prepare(frames.frame(learned[place])), len(learned))
    torch.manual_seed(config.train.seed)
    model = Canonicalizer(template, len(scans), config.canonicalizer).to(choose_device(config.device))
    task = canonicalizer.CanonicalizerTask(model, template, scans, names, config.train)
    trainer = Trainer(task, config.train, config.folder)
    trainer.fit()
    poses = torch.stack([scan.joint_transforms for scan in scans])
    facts = {"config": settings_to_dict(config), "frames": names, "steps": trainer.step, "seconds": trainer.seconds}
    write_weights(config.folder / canonicalizer.WEIGHTS, model.state_dict() | {canonicalizer.POSES: poses}, facts)
    return config.folder


def is_trained(config: CanonicalizeConfig) -> bool:
    """Whether a run's canonicalizer is there, valid and trained to its end."""
    try:
        facts = read_weights(config.folder / canonicalizer.WEIGHTS, ("steps", "seconds"))[1]
        return spent(config.train, int(facts["steps"]), float(facts["seconds"])) >= 1
    except DataError:
        return False


@prepared_process()
def canonicalize_frames(config: CanonicalizeConfig, frames: FrameDataset | None = None) -> list[Path]:
    """Writes every frame's canonical scan to ``<run>/scans/<split>/<frame>.npz``; gives the files in order.

    Training frames get a ``<frame>.ply`` beside it, for other programs. What an earlier call with the same weights
    and settings has finished is checked by hash and left as it is.
    """
    frames = frames or config.frames()
    template = frames.outfits[0].template
    source, made_by = skinning_source(config, template), scans_digest(config)
    written, done = [], Ledger(config.folder / "scans")
    for index, where in enumerate(tracked(frames.names, "canonicalize", unit="scan")):
        path = config.folder / "scans" / where.split / f"{where.name}.npz"
        written.append(path)
        made_of = frames.outfits[where.outfit].digest(where.split, where.name)
        name, key = f"{where.split}/{where.name}", digest_of({"canonicalizer": made_by, "frame": made_of})
        if done.find(name, key):
            continue
        frame = frames.frame(index)
        weights = source.weights_of(frame.scan.points, frame)
        scan = canonicalize_scan(frame.scan, frame.body, weights, template, config.stretch)
        files = [path]
        if where.split == "train":
            files.append(path.with_suffix(".ply"))
            if scan.faces is None:
                write_points(files[-1], PointCloud(scan.points, scan.normals))
            else:
                write_mesh(files[-1], Mesh(scan.points, scan.faces, scan.colors))
        write_canonical_scan(path, scan)
        done.record(name, key, files)
    return written


def skinning_source(config: CanonicalizeConfig, template: Template) -> SkinningSource:
    """What gives a run's scans their weights: its trained canonicalizer, or the body nearby."""
    if config.weights is WeightSource.learned:
        return canonicalizer.load_canonicalizer(config.folder, config.device)
    return BodyField(template, KNN if config.weights is WeightSource.knn else 1)


def scans_digest(config: CanonicalizeConfig) -> str:
    """One hash over all that a run's canonical scans depend on but the data: weights, scanner, cut and code."""
    plain = settings_to_dict(config)
    parts = {key: plain[key] for key in ("weights", "scan", "stretch")}
    if config.weights is WeightSource.learned:
        parts["learned"] = file_digest(config.folder / f"{canonicalizer.WEIGHTS}.safetensors")
    return keyed(SOURCE, program=module_digest(__name__), **parts)
