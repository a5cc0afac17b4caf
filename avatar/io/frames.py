"""Files of data sets: frames with cloth to 0.05 mm, garments, canonical scans, and the manifest of hashes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError, DataError, check_faces, check_finite, check_shape
from avatar.io.documents import read_json
from avatar.io.ledger import file_digest
from avatar.io.npz import naming, read_arrays, write_described, write_whole
from avatar.records import CanonicalScan

QUANTUM = 5e-5  # metres: 0.05 mm
FRAME_FORMAT, GARMENT_FORMAT = "open-frame/1", "open-garment/1"
SCAN_FORMAT, MANIFEST_FORMAT = "canonical-scan/1", "manifest/1"
MANIFEST = "manifest.json"
FARTHEST = 1000.0  # metres; the rounding of float32 is 0.06 mm there
FRAME_BYTES = 64 << 20  # far above any frame; refuses a file that swells on unpacking
FRAME = {
    "pose": "float J 3",
    "translation": "float 3",
    "origin": "float 3",
    "cloth_high": "uint8 3 V",
    "cloth_low": "uint8 3 V",
    "face_counts": "int 2",
    "visible_body": "uint8 B",
    "visible_cloth": "uint8 C",
    "penetration": "float 2",
}
HISTORY = {"history": "int "}
GARMENT = {"faces": "int F 3", "canonical": "float V 3", "labels": "uint8 V", "names": "text G"}
SCAN = {"points": "float M 3", "normals": "float M 3", "weights": "uint16 J M", "source": "int M"}
SCAN_EXTRAS = {"faces": "int F 3", "colors": "float M 3"}
WEIGHT_STEPS = np.iinfo(np.uint16).max  # weights are stored in this many steps: 15 millionths each
FAST = 1  # level of deflating: as small as level 9 but for 2%, in a tenth of the time
UNIT_TOLERANCE = 1e-2  # of normals and of the sums of weights


@dataclass(frozen=True)
class OpenFrame:
    """One simulated frame: ``pose (J, 3)`` axis-angle, ``translation (3,)``, posed ``cloth (Vc, 3)``, visible faces.

    ``penetration_share`` of cloth vertices inside the body, ``penetration_depth`` of the deepest, metres; ``history``
    counts the frames simulated before it, 0 where the cloth settled in this pose alone.
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
    """What all frames of an outfit share: ``faces (Fc, 3)``, ``canonical (Vc, 3)`` cloth at rest, metres, and
    ``labels (Vc,)`` uint8, 1 for the first of ``names``.
    """

    faces: np.ndarray
    canonical: np.ndarray
    labels: np.ndarray
    names: tuple[str, ...]


def write_open_frame(path: Path, frame: OpenFrame) -> None:
    """Writes a frame; cloth is rounded to 0.05 mm, as steps from vertex to vertex in mesh order, which deflate well.

    Raises `AvatarError` on wrong shapes, non-finite numbers or cloth wider than 3.2 m.
    """
    check_shape("cloth", frame.cloth, "V 3")
    check_finite("cloth", frame.cloth)
    cloth = np.asarray(frame.cloth, np.float64)
    origin = ((cloth.min(axis=0) + cloth.max(axis=0)) / 2).astype(np.float32)
    quanta = np.rint((cloth - origin) / QUANTUM)
    if np.abs(quanta).max() > np.iinfo(np.int16).max:
        raise AvatarError(f"cloth: expected at most 3.2 m across, got {np.ptp(cloth, axis=0).max():.2f} m.")
    steps = np.diff(quanta.astype(np.int16).view(np.uint16), axis=0, prepend=np.uint16(0)).T
    folded = np.where(steps < 1 << 15, steps << 1, ~(steps << 1))  # small steps either way: small numbers
    values = {
        "pose": frame.pose,
        "translation": frame.translation,
        "origin": origin,
        "cloth_high": folded >> 8,
        "cloth_low": folded & 255,
        "face_counts": [len(frame.visible_body), len(frame.visible_cloth)],
        "visible_body": np.packbits(np.asarray(frame.visible_body, bool)),
        "visible_cloth": np.packbits(np.asarray(frame.visible_cloth, bool)),
        "penetration": [frame.penetration_share, frame.penetration_depth],
        "history": frame.history or None,
    }
    write_described(path, FRAME_FORMAT, FRAME | HISTORY, values)


def read_open_frame(path: Path) -> OpenFrame:
    """Reads a frame of the open dataset; `DataError` for a missing or damaged file, another format or version."""
    stored = read_arrays(path, FRAME, HISTORY, FRAME_BYTES, FRAME_FORMAT)
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
    cloth = (quanta * QUANTUM + stored["origin"]).astype(np.float32)
    share, depth = stored["penetration"].tolist()
    history = int(stored.get("history", 0))
    return OpenFrame(
        stored["pose"],
        stored["translation"],
        cloth,
        **visible,
        penetration_share=share,
        penetration_depth=depth,
        history=history,
    )


def write_open_garment(path: Path, garment: OpenGarment) -> None:
    """Writes an outfit's garment. Raises `AvatarError` on wrong shapes, face indices or labels."""
    _check_garment(garment)
    write_described(path, GARMENT_FORMAT, GARMENT, {key: getattr(garment, key) for key in GARMENT})


def read_open_garment(path: Path) -> OpenGarment:
    """Reads an outfit's garment; faces come as int64. Raises `DataError` when the file is not valid."""
    stored = read_arrays(path, GARMENT, limit=FRAME_BYTES, version=GARMENT_FORMAT)
    faces, names = stored["faces"].astype(np.int64), tuple(stored["names"].tolist())
    garment = OpenGarment(faces, stored["canonical"], stored["labels"], names)
    with naming(path):
        _check_garment(garment)
    return garment


def _check_garment(garment: OpenGarment) -> None:
    check_faces(np.asarray(garment.faces), len(garment.canonical))
    labels = np.asarray(garment.labels)
    check_shape("labels", labels, "V", V=len(garment.canonical))
    if labels.min() < 1 or labels.max() > len(garment.names):
        raise AvatarError(f"labels: expected 1 to {len(garment.names)}, one number for each of {garment.names}.")


def write_canonical_scan(path: str | Path, scan: CanonicalScan) -> None:
    """Writes a canonical scan; weights are rounded to 1/65535, joint by joint, which deflates fast.

    Raises `AvatarError` as `check_canonical_scan` does.
    """
    check_canonical_scan(scan)
    weights = np.rint(np.asarray(scan.weights).T * WEIGHT_STEPS).astype(np.uint16)
    values = vars(scan) | {"weights": weights}
    described = SCAN | SCAN_EXTRAS
    write_described(Path(path), SCAN_FORMAT, described, {key: values[key] for key in described}, FAST)


def read_canonical_scan(path: str | Path) -> CanonicalScan:
    """Reads a canonical scan; indices come as int64. Raises `DataError` naming the file and what is wrong with it."""
    stored = read_arrays(path := Path(path), SCAN, SCAN_EXTRAS, version=SCAN_FORMAT)
    weights = stored["weights"].T.astype(np.float32)
    stored["weights"] = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1)
    scan = CanonicalScan(**{key: a.astype(np.int64) if a.dtype.kind in "iu" else a for key, a in stored.items()})
    with naming(path, "Canonicalize the scan again."):
        check_canonical_scan(scan)
    return scan


def check_canonical_scan(scan: CanonicalScan) -> None:
    """Refuses a canonical scan that is empty, not finite, or points at what it lacks; `AvatarError` names the field."""
    dims = check_shape("points", scan.points, "M 3")
    check_shape("normals", scan.normals, "M 3", **dims)
    check_shape("weights", scan.weights, "M J", **dims)
    check_shape("source", scan.source, "M", **dims)
    if not dims["M"]:
        raise AvatarError("points: expected at least one, got none.")
    for name in ("points", "normals", "weights"):
        check_finite(name, getattr(scan, name))
    for name, lengths in (("normals", np.linalg.norm(scan.normals, axis=1)), ("weights", scan.weights.sum(axis=1))):
        worst = float(lengths[np.abs(lengths - 1).argmax()])
        if abs(worst - 1) > UNIT_TOLERANCE:
            raise AvatarError(f"{name}: expected unit normals and rows of weights summing to 1, got {worst:.4g}.")
    if scan.weights.min() < 0 or scan.source.min() < 0 or (np.diff(scan.source) <= 0).any():
        raise AvatarError("weights, source: expected no negative weight and rising indices, got others.")
    if scan.faces is not None:
        check_faces(scan.faces, dims["M"])


def _listed_files(folder: Path) -> dict[str, Path]:
    """Files of a dataset folder by relative path, without the manifest and half-written temporaries."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    found = {path.relative_to(folder).as_posix(): path for path in files}
    return {name: path for name, path in found.items() if name != MANIFEST}


def write_manifest(folder: Path) -> Path:
    """Records size and sha256 of a dataset folder's files in its ``manifest.json``; returns its path."""
    folder = Path(folder)
    listed = _listed_files(folder).items()
    files = {name: {"size": path.stat().st_size, "sha256": file_digest(path)} for name, path in listed}
    text = json.dumps({"format": MANIFEST_FORMAT, "files": files}, indent=1)
    write_whole(folder / MANIFEST, f"{text}\n".encode())
    return folder / MANIFEST


def check_manifest(folder: Path, verify_hashes: bool = False) -> None:
    """Compares a dataset folder with its manifest, with hashes where asked; `DataError` names the file that differs."""
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
    for name in known | files:
        size, digest = known.get(name, (0, ""))
        if name not in files:
            problem = "the manifest lists it, it is not there."
        elif name not in known:
            problem = "it is not in the manifest."
        elif (found := files[name].stat().st_size) != size:
            problem = f"expected {size} bytes, got {found}."
        elif verify_hashes and file_digest(files[name]) != digest:
            problem = "its sha256 is not the manifest's: the content has changed."
        else:
            continue
        hint = "Make or download it again, or write the manifest anew if the change is meant."
        raise DataError(folder / name, problem, hint)
