"""What a point avatar takes from canonicalizers: skinning fields to be posed by, canonical scans to learn from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from avatar.body.packed import read_template
from avatar.canonical.fields import SkinningField, SkinningFieldConfig
from avatar.checks import DataError
from avatar.data.canonical_frames import CanonicalOutfit
from avatar.data.outfits import Outfit
from avatar.invocation import command_line
from avatar.io.documents import read_yaml
from avatar.nn.posing import LearnedSkinning
from avatar.records import Template
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.values import option

CANONICALIZERS = "canonical"  # the folder of their runs, beside those of the methods
SAME_BODY = 1e-3  # metres between the vertices of a canonicalizer's body and an outfit's, at most


def canonicalizer_folder(runs_root: Path, outfit: Outfit, name: str) -> Path:
    """The folder of an outfit's canonicalizer, ``<runs>/canonical/<dataset>/<outfit>/<name>``, after a check.

    Raises:
        DataError: with the command that makes it, when it is not there or was made for another body.
    """
    folder = runs_root / CANONICALIZERS / outfit.dataset / outfit.name / name
    where = [f"dataset={outfit.dataset}", f"outfit={outfit.name}", f"name={name}"]
    where += [] if runs_root == Path("runs") else [option("runs_root", runs_root)]
    command = command_line("canonicalize", *where)
    settings, anew = folder / "config.yaml", f"Delete {folder}, then run: {command}"
    if not settings.is_file():
        raise DataError(folder, f"expected the canonicalizer of {outfit.name}, there is none.", f"Make it: {command}")
    made = read_yaml(settings)
    whose = (made.get("dataset"), made.get("outfit"))
    if whose != (outfit.dataset, outfit.name):
        raise DataError(settings, f"expected the canonicalizer of {outfit.name}, it is one of {whose[1]}.", anew)
    found, body = read_template(folder / "template.npz"), outfit.template
    same = torch.equal(found.faces, body.faces) and found.parents == body.parents
    apart = float((found.vertices - body.vertices).norm(dim=1).max()) if same else torch.inf
    if apart > SAME_BODY:
        how = f"its canonical body is up to {apart * 100:.1f} cm elsewhere" if same else "its body is another mesh"
        raise DataError(folder / "template.npz", f"expected {outfit.name}'s body at rest, {how}.", anew)
    return folder


def canonical_outfits(runs_root: Path, outfits: list[Outfit], name: str) -> list[Outfit]:
    """The outfits in canonical space: scans of their canonicalizers' runs in place of the posed ones.

    Raises:
        DataError: when a training frame's scan has not been canonicalized.
    """
    resting = []
    for outfit in outfits:
        scans = canonicalizer_folder(runs_root, outfit, name) / "scans"
        resting.append(CanonicalOutfit(outfit, scans))
        missing = [frame for frame in outfit.frames("train") if not (scans / "train" / f"{frame}.npz").is_file()]
        if missing:
            problem = f"{len(missing)} of {outfit.name}'s train frames have no canonical scan, {missing[0]} for one."
            raise DataError(scans / "train", problem, "Run tools/canonicalize.py to its end.")
    return resting


def learned_skinning(runs_root: Path, outfits: list[Outfit], name: str, trainable: bool) -> LearnedSkinning:
    """Forward fields of the outfits' canonicalizers, ready to pose an avatar.

    Raises:
        DataError: when a canonicalizer is not there, or learned no field (weights=nearest, knn).
    """
    from avatar.training.canonicalizing import load_canonicalizer  # begins where runs do: at the top, a circle

    folders = [canonicalizer_folder(runs_root, outfit, name) for outfit in outfits]
    fields = [load_canonicalizer(folder, "cpu").forward_field for folder in folders]
    return LearnedSkinning(fields, [outfit.template for outfit in outfits], trainable)


def describe_fields(skinning: LearnedSkinning) -> list[dict[str, Any]]:
    """What `rebuild_skinning` needs beside the weights, as plain values."""
    return [settings_to_dict(field.config) for field in skinning.fields]


def rebuild_skinning(described: list[dict[str, Any]], template: Template) -> LearnedSkinning:
    """Skinning of the described sizes on a body of the run's topology, its state still to be loaded."""
    box = torch.tensor([[-1.0], [1.0]]).expand(2, 3)
    configs = [settings_from_dict(SkinningFieldConfig, values, "fields.") for values in described]
    fields = [SkinningField(len(template.parents), config, box) for config in configs]
    return LearnedSkinning(fields, [template] * len(fields))
