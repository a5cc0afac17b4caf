"""Textures of runs: colours of the training scans on the mesh of a trained avatar, in ``<run>/texture``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from avatar.checks import AvatarError, DataError, check_range, require
from avatar.data.layouts import OpenOutfit
from avatar.data.outfits import Outfit
from avatar.data.splits import split_outfit
from avatar.environment import prepared_process
from avatar.export.texturing import (
    Blend,
    Places,
    SeenColors,
    TexelMap,
    Unwrapped,
    bake,
    drop_mixed_borders,
    encode_png,
    fill_unseen,
    fit_distance,
    map_texels,
    paint_image,
    points_on_mesh,
    sample_image,
    unwrap,
    vertex_places,
)
from avatar.geometry.trees import build_tree
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.ledger import Ledger, keyed
from avatar.io.locks import lock_folder
from avatar.io.npz import write_whole
from avatar.io.textures import FILES, Texture, write_texture, write_textured_mesh
from avatar.methods.base import TrainedAvatar
from avatar.progress import tracked
from avatar.records import ClothedTemplate, Mesh, Scan
from avatar.runs.prediction import avatar_digest
from avatar.runs.training import load_avatar
from avatar.settings import settings_to_dict

SOURCE = ("avatar.runs.texturing",)
FOLDER = "texture"  # in a run's folder
MEASURED = 0.01  # metres from the mesh within which a scan's points measure a texture
FEWEST_POINTS = 1000  # that a predictor gives beside its mesh
TINY = 0.0002  # metres, the smallest texel


@dataclass
class TextureConfig:
    """A texture for the mesh of one run, from the coloured scans that it was trained on."""

    run: Path = Path("runs/layered/sample/dress/default")
    texel: float = 0.002  # metres at rest, a side; larger where the image would pass 4096 texels
    reach: float = 0.015  # metres from the mesh to the scan's points that colour it
    blend: Blend = Blend.first  # of the frames that show a texel: the one that fits best, or the mean of all
    frames: int | None = None  # training frames that are looked at, evenly spaced; all of them if null
    scored: int = 3  # test frames that measure the colours, evenly spaced; 0 for none
    pictures: int = 1  # of these frames, shown beside their scans
    data_root: Path | None = None  # where the data are now; where they were at training if null
    device: str = "auto"

    def __post_init__(self):
        check_range(self, "texel", low=TINY, high=0.5)
        check_range(self, "reach", above=0, high=0.5)
        check_range(self, "frames", low=1)
        check_range(self, "scored", "pictures", low=0)


@dataclass(frozen=True)
class Textured:
    """What `open_run` gives: a trained avatar with its template and outfit, ``vertices_of`` a frame of a split."""

    avatar: TrainedAvatar
    clothed: ClothedTemplate
    outfit: Outfit
    vertices_of: Callable

    def load(self, split: str, name: str) -> tuple[np.ndarray, Scan]:
        """The predicted vertices ``(V, 3)`` and the coloured scan of a frame.

        Raises `DataError` for a scan without colours.
        """
        frame = self.outfit.load(split, name)
        if frame.scan.colors is None:
            hint = "Train the run with scan.pattern=flowers, or on scans with colours."
            raise DataError(self.outfit.frame_path(split, name), "expected a scan with colours, got none.", hint)
        return self.vertices_of(frame.body), frame.scan


def open_run(config: TextureConfig) -> Textured:
    """A run that can have a texture. Raises `AvatarError` for one without meshes of constant topology."""
    avatar = load_avatar(config.run, device=config.device)
    clothed = avatar.method.mesh_template(avatar)
    if clothed is None:
        problem = f"run: expected a run with a mesh of its own, the same faces in every pose, got {config.run}."
        raise AvatarError(f"{problem} Hint: train method=layered.")
    outfit = replace(avatar.config, data_root=config.data_root or avatar.config.data_root).outfits()[0]
    dress = avatar.method.predictor(avatar, outfit.name, FEWEST_POINTS, ExtractionConfig())
    return Textured(avatar, clothed, outfit, lambda body: dress(body).mesh.vertices)


def spaced(names: tuple[str, ...], count: int | None) -> list[str]:
    """``count`` of the names, evenly spaced, from the middle of as many parts; all of them if None or fewer."""
    if count is None or count >= len(names):
        return list(names)
    return [names[int((place + 0.5) * len(names) / count)] for place in range(count)]


@prepared_process()
def make_texture(config: TextureConfig) -> Path:
    """Bakes a run's texture, unless nothing has changed since; gives its folder, ``<run>/texture``.

    Written there: ``texture.png`` and ``texture.npz`` (`avatar.io.textures`), ``template.glb`` (the template at rest
    with its texture) and ``report.json`` (what was seen, and errors of the colours).

    Raises:
        AvatarError: for a run without a mesh of its own, or without xatlas.
        DataError: for scans without colours.
    """
    require("xatlas")
    opened = open_run(config)
    outfit, folder = opened.outfit, config.run / FOLDER
    names = spaced(split_outfit(outfit, opened.avatar.config.split).train, config.frames)
    opened.load("train", names[0])  # without colours there is nothing to lock or to unwrap
    tested = spaced(outfit.frames("test"), config.scored) if config.scored and outfit.has_frames("test") else []
    with lock_folder(folder):
        plain = settings_to_dict(config)
        write_whole(folder / "config.yaml", yaml.safe_dump(plain, sort_keys=False).encode())
        source = (*SOURCE, *opened.avatar.method.sources)
        frames = {
            split: [outfit.digest(split, name) for name in s] for split, s in (("train", names), ("test", tested))
        }
        scanner = settings_to_dict(opened.avatar.config.scan)
        made = {name: plain[name] for name in ("texel", "reach", "blend")}
        key = keyed(source, avatar=avatar_digest(opened.avatar), frames=frames, scanner=scanner, settings=made)
        ledger = Ledger(folder)
        if not ledger.find(FOLDER, key):
            bake_run(config, opened, names, tested, folder)
            ledger.record(FOLDER, key, [folder / name for name in (*FILES, "template.glb", "report.json")])
    return folder


def bake_run(config: TextureConfig, opened: Textured, names: list[str], tested: list[str], folder: Path) -> None:
    """Unwraps, bakes, measures and writes a run's texture."""
    clothed = opened.clothed
    unwrapped = unwrap(clothed, config.texel)
    texels = map_texels(unwrapped, clothed.visible_faces)
    fits = [fit_distance(*opened.load("train", name), 2 * config.reach) for name in tracked(names, "fit of frames")]
    order = [names[index] for index in np.argsort(fits, kind="stable")]

    def shown() -> Iterator[tuple[np.ndarray, Scan]]:
        return (opened.load("train", name) for name in tracked(order, "colours"))

    seen = bake(texels.places, clothed.faces, shown(), config.reach, config.blend)
    seen = drop_mixed_borders(texels.places, seen, clothed)
    image = paint_image(texels, filled_colors(texels.places, seen, clothed))
    texture = Texture(clothed.faces, unwrapped.uv, unwrapped.uv_faces, encode_png(image))
    write_texture(folder, texture)
    write_textured_mesh(folder / "template.glb", Mesh(clothed.vertices, clothed.faces), texture)
    report = describe(seen, order, unwrapped, texels)
    if tested:
        report["errors"] = measure(opened, config, order[0], tested, unwrapped, image)
    write_whole(folder / "report.json", json.dumps(report, indent=1).encode())


def filled_colors(places: Places, seen: SeenColors, clothed: ClothedTemplate) -> np.ndarray:
    """Colours ``(T, 3)`` of all places, those that no scan showed continued from the others."""
    kinds = clothed.garment_faces
    return fill_unseen(places, seen.colors, seen.seen, clothed.vertices, clothed.faces, kinds)


def describe(seen: SeenColors, order: list[str], unwrapped: Unwrapped, texels: TexelMap) -> dict:
    """What a texture consists of: size, texels, and the shares of them that each frame and none has shown."""
    shares = np.bincount(seen.frames + 1, minlength=len(order) + 1) / len(seen.frames)
    return {
        "size": list(unwrapped.size),
        "texel_m": unwrapped.texel,
        "texels": len(texels.texels),
        "used": len(texels.texels) / (unwrapped.size[0] * unwrapped.size[1]),
        "unseen": float(shares[0]),
        "frames": {name: float(share) for name, share in zip(order, shares[1:]) if share},
    }


def measure(
    opened: Textured, config: TextureConfig, first: str, tested: list[str], unwrapped: Unwrapped, image: np.ndarray
) -> dict:
    """Mean absolute differences between scans' colours and those of the mesh where the scans' points lie.

    Of test frames and, where the true surface is known, of a fresh sampling of the ``first`` frame, in which nothing
    has moved: that error is of sharpness alone. ``texture`` beside ``vertices``, colours baked likewise at the mesh's
    vertices, ``nearest``, the nearest point of the first frame's scan, and ``flat``, the median colour of skin and of
    garment. The contrast is the spread of the colours on the garment, as a share of the scans'.
    """
    clothed, outfit = opened.clothed, opened.outfit
    vertices, scan = opened.load("train", first)
    places = vertex_places(clothed.faces, len(clothed.vertices))
    seen = drop_mixed_borders(places, bake(places, clothed.faces, [(vertices, scan)], config.reach), clothed)
    baked, tree = filled_colors(places, seen, clothed), build_tree(scan.points)
    kinds = clothed.garment_faces[places.face_ids]
    flat = np.stack([np.median(baked[kinds == kind] if (kinds == kind).any() else baked, axis=0) for kind in (0, 1)])
    ways: dict[str, Callable[[Places], np.ndarray]] = {
        "texture": lambda at: sample_image(image, at.on(unwrapped.uv, unwrapped.uv_faces)),
        "vertices": lambda at: at.on(baked, clothed.faces),
        "nearest": lambda at: scan.colors[tree.query(at.on(vertices, clothed.faces))[1]],
        "flat": lambda at: flat[clothed.garment_faces[at.face_ids].astype(np.int64)],
    }
    sets = {"test": [opened.load("test", name) for name in tested]}
    if isinstance(outfit, OpenOutfit):
        fresh = outfit.resample("train", first, len(scan.points), outfit.scanner.seed + 1)
        sets["first frame"] = [(vertices, fresh)]
    return {name: errors_of(ways, frames, clothed) for name, frames in sets.items()}


def errors_of(
    ways: dict[str, Callable[[Places], np.ndarray]], frames: list[tuple[np.ndarray, Scan]], clothed: ClothedTemplate
) -> dict:
    """Errors and contrast of each way to colour places, over the points of frames that lie on visible faces."""
    shown = np.flatnonzero(clothed.visible_faces)
    found: dict[str, list] = {name: [] for name in ways}
    near = []
    for vertices, scan in frames:
        at, kept = points_on_mesh(scan, vertices, clothed.faces[shown], MEASURED)
        at = Places(shown[at.face_ids], at.barycentric)
        near.append(len(kept) / len(scan.points))
        garment = clothed.garment_faces[at.face_ids]
        true = np.asarray(scan.colors, np.float64)[kept]
        for name, way in ways.items():
            colors = way(at)
            away = np.abs(colors - true).mean(axis=1)
            spread = colors[garment].std(axis=0).mean() / max(true[garment].std(axis=0).mean(), 1e-9)
            found[name].append([away.mean(), away[garment].mean(), spread])
    columns = ("error", "garment_error", "garment_contrast")
    means = {name: dict(zip(columns, np.mean(rows, axis=0).tolist())) for name, rows in found.items()}
    return {"points_near": float(np.mean(near)), **means}
