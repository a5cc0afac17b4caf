"""Which layout an outfit's folder has, and opening it."""

from __future__ import annotations

from pathlib import Path

from avatar.checks import DataError
from avatar.data.open_layout import OpenOutfit
from avatar.data.outfits import Outfit, outfit_folder, read_outfit_settings
from avatar.data.packed_layout import PackedOutfit
from avatar.data.scanner import ScanConfig

LAYOUTS = {
    "open": OpenOutfit,
    "packed": lambda path, dataset, scanner: PackedOutfit(path, dataset),
}


def find_outfit(root: Path, dataset: str, outfit: str, scanner: ScanConfig | None = None) -> Outfit:
    """An outfit by the name of its data set and its own: the embedded ``sample``, ``open``, or packed data.

    Args:
        root: the data root, with ``<dataset>/<outfit>`` below it.
        dataset: ``sample`` is the one that comes with the program and needs no root.
        outfit: the outfit's folder name.
        scanner: how simulated frames are scanned; a perfect scanner if None. Real scans are as they are.

    Raises:
        AvatarError: for names that could leave the data root.
        DataError: naming the outfits there are, or what is wrong with this one.
    """
    return open_outfit_folder(outfit_folder(root, dataset, outfit), dataset, scanner)


def open_outfit_folder(path: Path, dataset: str = "", scanner: ScanConfig | None = None) -> Outfit:
    """An outfit by its folder; the layout is what ``outfit.yaml`` says, or what its files show.

    Raises:
        DataError: for an unknown layout, naming those there are.
    """
    path = Path(path)
    shown = "open" if (path / "garment.npz").is_file() else "packed"
    layout = read_outfit_settings(path).get("layout", shown)
    if layout not in LAYOUTS:
        raise DataError(path / "outfit.yaml", f"layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}.")
    return LAYOUTS[layout](path, dataset, scanner)
