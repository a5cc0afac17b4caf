"""The open dataset's files: frames with cloth to 0.05 mm, garments, and the manifest of hashes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError, DataError, check_faces, check_finite, check_shape
from avatar.io.documents import read_json
from avatar.io.ledger import file_digest
from avatar.io.npz import read_arrays, write_arrays, write_whole

QUANTUM = 5e-5  # metres: 0.05 mm
FRAME_FORMAT, GARMENT_FORMAT, MANIFEST_FORMAT = "open-frame/1", "open-garment/1", "manifest/1"
MANIFEST = "manifest.json"
FARTHEST = 1000.0  # metres; the rounding of float32 is 0.06 mm there
FRAME_BYTES = 64 << 20  # far above any frame; refuses a file that swells on unpacking


@dataclass(frozen=True)
class OpenFrame:
    """One simulated frame of the open dataset: the body's pose, the cloth, and which faces can be seen.

    ``pose (J, 3)`` axis-angle, radians; ``translation (3,)`` metres; ``cloth (Vc, 3)`` metres, posed;
    ``visible_body (Fb,)`` and ``visible_cloth (Fc,)`` bool per face; ``penetration_share`` share of cloth
    vertices inside the body, ``penetration_depth`` the deepest of them, metres; ``history`` how many frames were
    simulated one after another before it: 0 where the cloth settled in this pose alone.
    """

    pose: np.ndarray
    translation: np.ndarray
    cloth: np.ndarray
    visible_body: np.ndarray
    visible_cloth: np.ndarray
    penetration_share: float = 0.0
    penetration_depth: float = 0.0
    history: int = 0


@dataclass(frozen=True)
class OpenGarment:
    """What all frames of an outfit share: the cloth's topology and its rest in the canonical pose.

    ``faces (Fc, 3)``; ``canonical (Vc, 3)`` cloth settled in the canonical pose, metres; ``labels (Vc,)``
    uint8, 1 for the first garment of ``names``.
    """

    faces: np.ndarray
    canonical: np.ndarray
    labels: np.ndarray
    names: tuple[str, ...]


def write_open_frame(path: Path, frame: OpenFrame) -> None:
    """Writes a frame; cloth is rounded to 0.05 mm, everything else is exact.

    Cloth is stored as steps from vertex to vertex in mesh order, high bytes apart from low bytes, because
    both deflate well that way.

    Raises:
        AvatarError: on wrong shapes, non-finite numbers or cloth wider than 3.2 m.
    """
    check_shape("pose", frame.pose, "J 3")
    check_shape("translation", frame.translation, "3")
    check_shape("cloth", frame.cloth, "V 3")
    for name in ("pose", "translation", "cloth"):
        check_finite(name, getattr(frame, name))
    cloth = np.asarray(frame.cloth, np.float64)
    origin = ((cloth.min(axis=0) + cloth.max(axis=0)) / 2).astype(np.float32)
    quanta = np.rint((cloth - origin) / QUANTUM)
    if np.abs(quanta).max() > np.iinfo(np.int16).max:
        raise AvatarError(f"cloth: expected at most 3.2 m across, got {np.ptp(cloth, axis=0).max():.2f} m.")
    steps = np.diff(quanta.astype(np.int16).view(np.uint16), axis=0, prepend=np.uint16(0)).T
    folded = np.where(steps < 1 << 15, steps << 1, ~(steps << 1))  # small steps either way: small numbers
    numbers = {
        "format": np.array(FRAME_FORMAT),
        "pose": np.asarray(frame.pose, np.float32),
        "translation": np.asarray(frame.translation, np.float32),
        "origin": origin,
        "cloth_high": (folded >> 8).astype(np.uint8),
        "cloth_low": (folded & 255).astype(np.uint8),
        "face_counts": np.array([len(frame.visible_body), len(frame.visible_cloth)], np.int32),
        "visible_body": np.packbits(np.asarray(frame.visible_body, bool)),
        "visible_cloth": np.packbits(np.asarray(frame.visible_cloth, bool)),
        "penetration": np.array([frame.penetration_share, frame.penetration_depth], np.float32),
    }
    write_arrays(path, numbers | ({"history": np.array(frame.history, np.int32)} if frame.history else {}))


def read_open_frame(path: Path) -> OpenFrame:
    """Reads a frame of the open dataset.

    Raises:
        DataError: when the file is missing, damaged, of another format or version.
    """
    stored = read_arrays(
        path,
        {
            "pose": "float J 3",
            "translation": "float 3",
            "origin": "float 3",
            "cloth_high": "uint8 3 V",
            "cloth_low": "uint8 3 V",
            "face_counts": "int 2",
            "visible_body": "uint8 B",
            "visible_cloth": "uint8 C",
            "penetration": "float 2",
        },
        {"history": "int "},
        limit=FRAME_BYTES,
        version=FRAME_FORMAT,
    )
    for key in ("origin", "translation"):
        if np.abs(stored[key]).max() > FARTHEST:
            raise DataError(path, f"{key}: expected metres within {FARTHEST:g} of the origin, got {stored[key]}.")
    folded = (stored["cloth_high"].astype(np.uint16) << 8) | stored["cloth_low"]
    steps = np.where(folded & 1, ~(folded >> 1), folded >> 1)
    quanta = np.cumsum(steps, axis=1, dtype=np.uint16).view(np.int16).T
    visible = {}
    for key, count in zip(("visible_body", "visible_cloth"), stored["face_counts"].tolist()):
        if (count + 7) // 8 != len(stored[key]):
            raise DataError(path, f"{key}: expected bits for {count} faces, got {len(stored[key])} bytes.")
        visible[key] = np.unpackbits(stored[key], count=count).astype(bool)
    return OpenFrame(
        pose=stored["pose"],
        translation=stored["translation"],
        cloth=(quanta * QUANTUM + stored["origin"]).astype(np.float32),
        penetration_share=float(stored["penetration"][0]),
        penetration_depth=float(stored["penetration"][1]),
        history=int(stored.get("history", 0)),
        **visible,
    )


def write_open_garment(path: Path, garment: OpenGarment) -> None:
    """Writes an outfit's garment. Raises `AvatarError` on wrong shapes, face indices or labels."""
    dims = check_shape("canonical", garment.canonical, "V 3")
    check_shape("labels", garment.labels, "V", **dims)
    check_finite("canonical", garment.canonical)
    _check_garment(garment)
    write_arrays(
        path,
        {
            "format": np.array(GARMENT_FORMAT),
            "faces": np.asarray(garment.faces, np.int32),
            "canonical": np.asarray(garment.canonical, np.float32),
            "labels": np.asarray(garment.labels, np.uint8),
            "names": np.array(garment.names, dtype=np.str_),
        },
    )


def read_open_garment(path: Path) -> OpenGarment:
    """Reads an outfit's garment; faces come as int64. Raises `DataError` when the file is not valid."""
    keys = {"faces": "int F 3", "canonical": "float V 3", "labels": "uint8 V", "names": "text G"}
    stored = read_arrays(path, keys, limit=FRAME_BYTES, version=GARMENT_FORMAT)
    names = tuple(str(name) for name in stored["names"])
    garment = OpenGarment(stored["faces"].astype(np.int64), stored["canonical"], stored["labels"], names)
    try:
        _check_garment(garment)
    except AvatarError as error:
        raise DataError(path, str(error)) from error
    return garment


def _check_garment(garment: OpenGarment) -> None:
    """Refuses faces or labels that point at nothing."""
    check_faces(np.asarray(garment.faces), len(garment.canonical))
    labels = np.asarray(garment.labels)
    if labels.min() < 1 or labels.max() > len(garment.names):
        raise AvatarError(f"labels: expected 1 to {len(garment.names)}, one number for each of {garment.names}.")


def _listed_files(folder: Path) -> dict[str, Path]:
    """Files of a dataset folder by relative path, without the manifest and half-written temporaries."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    found = {path.relative_to(folder).as_posix(): path for path in files}
    return {name: path for name, path in found.items() if name != MANIFEST}


def write_manifest(folder: Path) -> Path:
    """Records size and sha256 of a dataset folder's files in its ``manifest.json``; returns its path."""
    folder = Path(folder)
    listed = _listed_files(folder)
    files = {name: {"size": path.stat().st_size, "sha256": file_digest(path)} for name, path in listed.items()}
    text = json.dumps({"format": MANIFEST_FORMAT, "files": files}, indent=1)
    write_whole(folder / MANIFEST, f"{text}\n".encode())
    return folder / MANIFEST


def check_manifest(folder: Path, verify_hashes: bool = False) -> None:
    """Compares a dataset folder with its manifest: the same files of the same sizes, and hashes where asked.

    Raises:
        DataError: naming the file that is missing, changed or not in the manifest.
    """
    folder = Path(folder)
    path = folder / MANIFEST
    try:
        manifest = read_json(path)
        known = {name: (int(entry["size"]), entry["sha256"]) for name, entry in manifest["files"].items()}
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise DataError(path, f"expected a manifest, reading failed: {error}.") from error
    if manifest.get("format") != MANIFEST_FORMAT:
        raise DataError(path, f"expected format {MANIFEST_FORMAT}, got {manifest.get('format')}.")
    files = _listed_files(folder)
    for name in [*known, *(name for name in files if name not in known)]:
        hint = "Make or download it again, or write the manifest anew if the change is meant."
        if name not in files:
            raise DataError(folder / name, "the manifest lists it, it is not there.", hint)
        if name not in known:
            raise DataError(files[name], "it is not in the manifest.", hint)
        size, digest = known[name]
        if files[name].stat().st_size != size:
            raise DataError(files[name], f"expected {size} bytes, got {files[name].stat().st_size}.", hint)
        if verify_hashes and file_digest(files[name]) != digest:
            raise DataError(files[name], "its sha256 is not the manifest's: the content has changed.", hint)
