"""Folders of outfits: which there are on disk and in the package, and what ``outfit.yaml`` says; without torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from avatar.checks import SAFE_NAME, DataError, check_name, did_you_mean, sentences
from avatar.io.documents import read_yaml

SPLITS = ("train", "test", "interpolation")  # interpolation: unseen poses of the kind that train has
VALIDATION = "validation"  # training frames that a run held back: a split of `Outfit.with_validation`
SAMPLE_FOLDER = Path(__file__).parents[1] / "assets" / "sample"
OUTFIT_FORMAT = "outfit/1"
READ_KEYS = {"format", "layout", "body", "mean_body"}  # of outfit.yaml
KNOWN_KEYS = READ_KEYS | {"name", "units", "up", "licence", "source", "garments", "travel", "gates", "versions"}


def read_outfit_settings(path: Path) -> dict[str, Any]:
    """What ``outfit.yaml`` says, nothing where there is none.

    Raises `DataError` for no mapping, an unknown format or misspelt keys.
    """
    file = Path(path) / "outfit.yaml"
    if not file.is_file():
        return {}
    settings = read_yaml(file)
    if settings.get("format", OUTFIT_FORMAT) != OUTFIT_FORMAT:
        raise DataError(file, f"expected format {OUTFIT_FORMAT}, got {settings['format']}.", "Make the data again.")
    for key in settings.keys() - KNOWN_KEYS:
        if near := did_you_mean(key, READ_KEYS - settings.keys()):
            raise DataError(file, f"expected keys such as {', '.join(sorted(READ_KEYS))}, got {key!r}.", near)
    return settings


def outfit_folder(root: Path, dataset: str, outfit: str) -> Path:
    """The folder ``<root>/<dataset>[/packed]/<outfit>``, or the embedded one for the dataset ``sample``.

    Raises `AvatarError` for names that could leave the data root; `DataError` naming the outfits that are there.
    """
    check_name("dataset", dataset)
    check_name("outfit", outfit)
    parent = SAMPLE_FOLDER if dataset == "sample" else Path(root) / dataset
    if (parent / "packed").is_dir():
        parent = parent / "packed"
    if not parent.is_dir():
        near = did_you_mean(dataset, ["sample", *(path.name for path in Path(root).glob("*/"))])
        hint = f"Make it with tools/simulate.py, or put the data there as {parent}/<outfit>/train/*.npz."
        raise DataError(parent, f"expected the folder of data set {dataset}, there is none.", sentences(near, hint))
    there = outfit_names(parent)
    if outfit not in there:
        hint = sentences(did_you_mean(outfit, there), f"There are: {', '.join(there) or 'none'}.")
        raise DataError(parent / outfit, "no such outfit.", hint)
    folder = parent / outfit
    if not folder.resolve().is_relative_to(parent.resolve()):
        raise DataError(folder, f"expected a folder inside {parent}, it is a link to {folder.resolve()}.")
    return folder


def outfit_names(parent: Path) -> tuple[str, ...]:
    """Names of the outfits in a data set's folder: those with a ``train`` or ``test`` folder, sorted."""
    folders = (p for p in Path(parent).iterdir() if any((p / split).is_dir() for split in SPLITS))
    return tuple(sorted(p.name for p in folders if SAFE_NAME.fullmatch(p.name)))
