"""Clothed templates' runs: from a canonicalizer's scans to ``template/`` in its folder, step by step and resumable."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from torch.utils.data import Subset

from avatar.canonical.clothed import (
    FEW_SCANS,
    ClothedConfig,
    Garment,
    ScanInPose,
    WeighedGarment,
    assemble,
    find_faults,
    find_skin,
    fuse_garment,
    template_facts,
    weigh_garment,
)
from avatar.canonical.refinement import PosedPoints
from avatar.canonical.scans import root_joint_transforms, to_root_frame
from avatar.canonical.skin import SkinVote
from avatar.checks import AvatarError, DataError, check_name, require
from avatar.data.batches import LruSequence
from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.invocation import command_line
from avatar.io.clothed_templates import write_clothed_template
from avatar.io.frames import read_canonical_scan
from avatar.io.ledger import Ledger, file_digest, keyed
from avatar.io.locks import lock_folder
from avatar.io.meshes import write_mesh
from avatar.io.npz import read_arrays, write_arrays, write_whole
from avatar.methods.canonicalizer import WEIGHTS, canonicalizer_folder, find_field
from avatar.progress import tracked
from avatar.records import ClothedTemplate, Mesh, Template
from avatar.settings import settings_to_dict

SOURCE = ("avatar.canonical.clothed", "avatar.runs.templating")
SKIN_COLOR, GARMENT_COLOR = (0.86, 0.66, 0.56), (0.42, 0.52, 0.72)
SKIN_KEYS = {"bare": "bool V", "seen": "float V"}
MESH_KEYS = {"vertices": "float V 3", "faces": "int F 3"}


@dataclass
class TemplateConfig:
    """One outfit's clothed template: from which canonical scans, and how."""

    dataset: str = "sample"
    outfit: str = "dress"
    canonical: str = "default"  # name of the canonicalizer's run
    data_root: Path = Path("data")
    runs_root: Path = Path("runs")
    clothed: ClothedConfig = field(default_factory=ClothedConfig)
    pictures: int = 3  # poses in pictures; 0 for no pictures

    def __post_init__(self):
        for what in ("canonical", "dataset", "outfit"):
            check_name(what, getattr(self, what))
        if self.pictures < 0:
            raise AvatarError(f"pictures: expected at least 0, got {self.pictures}.")

    def find_outfit(self) -> Outfit:
        """The outfit on disk."""
        return find_outfit(self.data_root, self.dataset, self.outfit)

    def find_run(self, outfit: Outfit) -> Path:
        """The canonicalizer's folder. Raises `DataError` with the command that makes it."""
        return canonicalizer_folder(self.runs_root, outfit, self.canonical)


def template_scans(folder: Path, outfit: Outfit) -> tuple[tuple[str, ...], LruSequence[ScanInPose]]:
    """Names and canonical scans of an outfit's training frames, from a canonicalizer's folder, with their bodies.

    Raises `DataError` when there is none.
    """
    known = frozenset(outfit.frames("train"))
    names = tuple(sorted(path.stem for path in (folder / "scans" / "train").glob("*.npz") if path.stem in known))
    if not names:
        command = command_line("canonicalize", f"dataset={outfit.dataset}", f"outfit={outfit.name}")
        problem = f"expected canonical scans of {outfit.name}'s train frames, there are none."
        raise DataError(folder / "scans" / "train", problem, f"Make them: {command}")
    template = outfit.template

    def read(index: int) -> ScanInPose:
        path = folder / "scans" / "train" / f"{names[index]}.npz"
        body = outfit.load_body("train", names[index])
        try:
            vertices = to_root_frame(body.vertices, body).numpy()
            return ScanInPose(read_canonical_scan(path), root_joint_transforms(body), vertices, template)
        except DataError:
            raise
        except AvatarError as error:
            raise DataError(path, str(error), "Canonicalize with more points a scan.") from error

    return names, LruSequence(read, len(names))


def hold_back(count: int, share: float) -> tuple[list[int], list[int]]:
    """Indices of the scans that make a template, and of those that measure it: evenly spaced, none where few."""
    number = max(1, round(share * count)) if share and count >= FEW_SCANS else 0
    held = {round((place + 0.5) * count / number) for place in range(number)}
    held = {min(index, count - 1) for index in held}
    return [index for index in range(count) if index not in held], sorted(held)


@prepared_process()
def make_template(config: TemplateConfig) -> Path:
    """Makes an outfit's clothed template, or goes on with it; gives its folder, ``<canonicalizer's run>/template``.

    Written there: ``template.npz``, ``template.ply`` (skin and garment in two colours) and ``report.json``. Each step's
    result is kept in ``steps/``; those whose scans, settings and code have not changed are not done again.

    Raises:
        DataError: without canonical scans, with the command that makes them.
        AvatarError: when the scans do not make a surface, or without pyacvd.
    """
    require("pyacvd")
    outfit = config.find_outfit()
    run = config.find_run(outfit)
    names, scans = template_scans(run, outfit)
    folder, template, settings = run / "template", outfit.template, config.clothed
    with lock_folder(folder):
        write_whole(folder / "config.yaml", yaml.safe_dump(settings_to_dict(config), sort_keys=False).encode())
        made, held = hold_back(len(names), settings.held_back)
        seen, measured = Subset(scans, made), Subset(scans, held)
        files = {name: file_digest(run / "scans" / "train" / f"{name}.npz") for name in names}
        bodies = {name: outfit.digest("train", name) for name in names}
        field_file = run / f"{WEIGHTS}.safetensors"
        learned = file_digest(field_file) if field_file.is_file() else "body"
        plain = settings_to_dict(settings)
        key = keyed(SOURCE, scans=files, frames=bodies, field=learned, settings=plain)
        ledger = Ledger(folder)
        vote = kept_skin(folder, ledger, key, lambda: find_skin(seen, template, settings))
        garment = kept_garment(folder, ledger, key, lambda: fuse_garment(seen, template, vote, settings))
        if not ledger.find("template", key):
            weighed = None
            if len(garment.mesh.faces):
                points = [garment_of(scan, vote) for scan in tracked(seen, "garment points", unit="scan")]
                unseen = [garment_of(scan, vote) for scan in measured]
                field_of = find_field(run, template)
                weighed = weigh_garment(garment.mesh, template, field_of, points, unseen, settings)
            write_template_files(folder, template, vote, garment, weighed, (len(made), len(held)), settings)
            written = [folder / name for name in ("template.npz", "template.ply", "report.json")]
            ledger.record("template", key, written)
    return folder


def garment_of(scan: ScanInPose, vote: SkinVote) -> PosedPoints:
    """The garment's points of a scan in its pose."""
    return PosedPoints(scan.posed[0][scan.garment_points(vote)], scan.joint_transforms)


def kept_skin(folder: Path, ledger: Ledger, key: str, make: Callable[[], SkinVote]) -> SkinVote:
    """The vote for skin, from ``steps/skin.npz`` where it is there for this key."""
    path = folder / "steps" / "skin.npz"
    note = ledger.find("skin", key)
    if not note:
        vote = make()
        write_arrays(path, {"bare": vote.bare, "seen": vote.seen})
        note = {"noise": vote.noise, "spread": vote.spread}
        ledger.record("skin", key, [path], note)
    return SkinVote(**read_arrays(path, SKIN_KEYS), **note)


def kept_garment(folder: Path, ledger: Ledger, key: str, make: Callable[[], Garment]) -> Garment:
    """The garment's mesh, from ``steps/garment.npz`` where it is there for this key."""
    path = folder / "steps" / "garment.npz"
    note = ledger.find("garment", key)
    if not note:
        garment = make()
        write_arrays(path, {"vertices": garment.mesh.vertices, "faces": garment.mesh.faces})
        note = {"filled": garment.filled, "dropped": garment.dropped}
        ledger.record("garment", key, [path], note)
    return Garment(Mesh(**read_arrays(path, MESH_KEYS)), **note)


def skin_colors(clothed: ClothedTemplate) -> np.ndarray:
    """Colours ``(V, 3)`` of skin and garment."""
    return np.where((clothed.body_vertex >= 0)[:, None], SKIN_COLOR, GARMENT_COLOR)


def write_template_files(
    folder: Path,
    template: Template,
    vote: SkinVote,
    garment: Garment,
    weighed: WeighedGarment | None,
    scans: tuple[int, int],
    settings: ClothedConfig,
) -> None:
    """Writes ``template.npz``, ``template.ply`` and ``report.json``; ``scans`` are those used and those held back."""
    clothed = assemble(template, vote, weighed, settings)
    facts = template_facts(clothed, template)
    report = {
        "scans": scans[0],
        "held_back": scans[1],
        "noise_m": vote.noise,
        "spread_m": vote.spread,
        "bare_share": float(vote.bare.mean()),
        "counts": facts,
        "weights": None if weighed is None else weighed.kind,
        "refined": weighed is not None and weighed.refined,
        "chamfer_m2": {} if weighed is None else weighed.errors,
        "filled_m2": garment.filled,
        "dropped_m2": garment.dropped,
        "faults": find_faults(facts, scans[0], vote, garment, weighed),
        "settings": settings_to_dict(settings),
    }
    write_clothed_template(folder / "template.npz", clothed)
    write_mesh(folder / "template.ply", Mesh(clothed.vertices, clothed.faces, skin_colors(clothed)))
    write_whole(folder / "report.json", json.dumps(report, indent=1).encode())
