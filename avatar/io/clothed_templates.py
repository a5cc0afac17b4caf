"""Clothed templates on disk: one npz an outfit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatar.checks import AvatarError, DataError, check_faces, check_finite, check_shape
from avatar.io.npz import read_arrays, write_arrays
from avatar.records import ClothedTemplate

FORMAT = "clothed-template/1"
UNIT_TOLERANCE = 1e-3  # of the sums of weights
KEYS = {
    "vertices": "float V 3",
    "faces": "int F 3",
    "weights": "float V J",
    "body_vertex": "int V",
    "covered": "bool V",
}
KINDS = {"vertices": np.float32, "faces": np.int32, "weights": np.float32, "body_vertex": np.int32, "covered": bool}


def write_clothed_template(path: str | Path, clothed: ClothedTemplate) -> None:
    """Writes a clothed template: float32, int32 and bool. Raises `AvatarError` as `check_clothed_template` does."""
    check_clothed_template(clothed)
    arrays = {name: np.asarray(getattr(clothed, name), kind) for name, kind in KINDS.items()}
    write_arrays(Path(path), {"format": np.array(FORMAT)} | arrays)


def read_clothed_template(path: str | Path) -> ClothedTemplate:
    """Reads a clothed template, checked; indices come as int64.
    Raises `DataError` that names the file and what is wrong with it.
    """
    path = Path(path)
    stored = read_arrays(path, KEYS, version=FORMAT)
    indices = {name: stored[name].astype(np.int64) for name in ("faces", "body_vertex")}
    clothed = ClothedTemplate(**stored | indices)
    try:
        check_clothed_template(clothed)
    except AvatarError as error:
        raise DataError(path, str(error), "Make the template again: python tools/template.py.") from error
    return clothed


def check_clothed_template(clothed: ClothedTemplate) -> None:
    """Refuses a clothed template that is not one.

    Raises:
        AvatarError: for shapes that do not fit, non-finite numbers, weights that do not sum to 1, indices out of
            range, covered vertices of the garment, or faces between skin and garment.
    """
    dims = check_shape("vertices", clothed.vertices, "V 3")
    check_shape("weights", clothed.weights, "V J", **dims)
    for name in ("body_vertex", "covered"):
        check_shape(name, getattr(clothed, name), "V", **dims)
    check_faces(clothed.faces, dims["V"])
    for name in ("vertices", "weights"):
        check_finite(name, getattr(clothed, name))
    sums = clothed.weights.sum(axis=1)
    if len(sums) and (np.abs(sums - 1).max() > UNIT_TOLERANCE or clothed.weights.min() < 0):
        raise AvatarError("weights: expected no negative weight and rows summing to 1, got others.")
    if len(sums) and clothed.body_vertex.min() < -1:
        raise AvatarError(f"body_vertex: expected -1 or an index of the body, got {clothed.body_vertex.min()}.")
    if covered := int(clothed.covered[clothed.body_vertex < 0].sum()):
        raise AvatarError(f"covered: expected skin vertices alone, got {covered} of the garment.")
    garment = clothed.body_vertex[clothed.faces] < 0
    if (garment.any(axis=1) & ~garment.all(axis=1)).any():
        raise AvatarError("faces: expected none between skin and garment, got some.")
