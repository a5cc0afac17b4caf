"""Moving points, meshes and pictures for other programs: USD caches, animated GIF and WebP."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from avatar.checks import AvatarError, check_oriented, check_shape, check_suffix, require
from avatar.export.pictures import disc_radii
from avatar.io.meshes import check_mesh
from avatar.io.npz import write_whole
from avatar.records import Mesh, PointCloud

USD_FORMATS = (".usdc", ".usda", ".usd")
PICTURE_FORMATS = {".gif": ("GIF", 10), ".webp": ("WEBP", 1)}  # with the length of a tick, ms


def write_usd_points(
    path: str | Path, clouds: Iterable[PointCloud], fps: float, frames: Sequence[int] | None = None
) -> None:
    """Writes a sequence of oriented points as USD: one `Points` prim, time-sampled, counts may change.

    Metres, y up. Widths are the points' own spacing, so that Blender or usdview show a closed surface. ``path`` ends in
    .usdc (compact), .usda (text) or .usd; of ``clouds``, one a frame, only one is in memory at a time. ``frames`` are
    their numbers, rising, which become time codes (0, 1, 2, ... if None); where numbers are missing the frame before
    them is held. Raises `AvatarError` for no frames, wrong shapes, numbers, non-finite values or fps, or without
    usd-core; `DataError` for another file name ending.
    """
    with _usd_stage(path, fps) as stage:
        prim = require("pxr.UsdGeom").Points.Define(stage, "/avatar/points")
        prim.SetNormalsInterpolation("vertex")
        for cloud, frame in _samples(stage, clouds, frames):
            check_oriented(cloud.points, cloud.normals)
            widths = 2 * disc_radii(np.asarray(cloud.points, np.float64))
            prim.GetPointsAttr().Set(_vectors(cloud.points), frame)
            prim.GetNormalsAttr().Set(_vectors(cloud.normals), frame)
            prim.GetWidthsAttr().Set(require("pxr.Vt").FloatArray.FromNumpy(widths.astype(np.float32)), frame)
            prim.GetExtentAttr().Set(_extent(cloud.points, widths.max() / 2), frame)


def write_usd_meshes(path: str | Path, meshes: Iterable[Mesh], fps: float, frames: Sequence[int] | None = None) -> None:
    """Writes a sequence of meshes as USD: one `Mesh` prim, time-sampled, whose triangles may change by frame.

    Metres, y up, right-handed, no subdivision; colours become ``displayColor``. Blender, Maya and Unreal read it.
    Arguments and errors as `write_usd_points`; `AvatarError` for meshes that are not valid as well.
    """
    with _usd_stage(path, fps) as stage:
        prim = require("pxr.UsdGeom").Mesh.Define(stage, "/avatar/mesh")
        prim.CreateSubdivisionSchemeAttr("none")
        prim.CreateOrientationAttr("rightHanded")
        prim.CreateDoubleSidedAttr(True)
        for mesh, frame in _samples(stage, meshes, frames):
            check_mesh(mesh)
            prim.GetPointsAttr().Set(_vectors(mesh.vertices), frame)
            prim.GetFaceVertexCountsAttr().Set(_whole(np.full(len(mesh.faces), 3)), frame)
            prim.GetFaceVertexIndicesAttr().Set(_whole(np.reshape(mesh.faces, -1)), frame)
            prim.GetExtentAttr().Set(_extent(mesh.vertices, 0.0), frame)
            if mesh.colors is not None:
                prim.CreateDisplayColorPrimvar("vertex").Set(_vectors(mesh.colors), frame)


@contextmanager
def _usd_stage(path: str | Path, fps: float) -> Iterator[Any]:
    """A USD stage in metres, y up; at the end of the ``with`` block its file is there whole, or not at all."""
    path = Path(path)
    suffix = check_suffix(path, USD_FORMATS, "a USD file")
    _check_fps(fps)
    usd, usd_geom = require("pxr.Usd"), require("pxr.UsdGeom")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.stem}-", dir=path.parent) as folder:
        partial = Path(folder) / f"stage{suffix}"
        stage = usd.Stage.CreateNew(str(partial))
        usd_geom.SetStageUpAxis(stage, usd_geom.Tokens.y)
        usd_geom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetDefaultPrim(usd_geom.Xform.Define(stage, "/avatar").GetPrim())
        yield stage
        stage.GetRootLayer().Save()
        partial.replace(path)


def _samples(stage: Any, items: Iterable, frames: Sequence[int] | None) -> Iterator[tuple[Any, int]]:
    """Items with their time codes; at the end of a gap the one before it again, as programs blend neighbours."""
    last = held = None
    for number, item in _numbered(items, frames):
        if last is None:
            stage.SetStartTimeCode(number)
        elif number > last + 1:
            yield held, number - 1
        yield item, number
        last, held = number, item
    stage.SetEndTimeCode(last)


def _numbered(items: Iterable, frames: Sequence[int] | None) -> Iterator[tuple[int, Any]]:
    """Items with their frames' numbers, from 0 on if None; at least one, with a number each, and rising."""
    count = 0
    for count, item in enumerate(items, start=1):
        if frames is not None and (count > len(frames) or (count > 1 and frames[count - 1] <= frames[count - 2])):
            raise AvatarError(f"frames: expected a rising number for each item, got {list(frames)[:count]}.")
        yield (count - 1 if frames is None else int(frames[count - 1])), item
    if not count or (frames is not None and count < len(frames)):
        wanted = "at least one" if frames is None else str(len(frames))
        raise AvatarError(f"frames: expected {wanted} to write, got {count or 'none'}.")


def _vectors(values: np.ndarray) -> Any:
    return require("pxr.Vt").Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def _whole(values: np.ndarray) -> Any:
    return require("pxr.Vt").IntArray.FromNumpy(np.ascontiguousarray(values, np.int32))


def _extent(points: np.ndarray, margin: float) -> Any:
    return _vectors(np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin]))


def _check_fps(fps: float) -> None:
    if not 0 < fps <= 1000:
        raise AvatarError(f"fps: expected frames per second in (0, 1000], got {fps}.")


def write_animation(
    path: str | Path, images: Sequence[np.ndarray], fps: float, frames: Sequence[int] | None = None
) -> None:
    """Writes ``(H, W, 3)`` uint8 pictures of one size as a film that loops: .webp, or .gif in 255 colours, 10 ms steps.

    Each picture stands until the next one's time, so that a film is as long as its ``frames``' rising numbers say
    (0, 1, 2, ... if None); the first one's is the beginning. Raises `AvatarError` for no pictures, different sizes,
    numbers or fps; `DataError` for another file name ending.
    """
    path = Path(path)
    suffix = check_suffix(path, PICTURE_FORMATS, "a film")
    _check_fps(fps)
    if not len(images):
        raise AvatarError("images: expected at least one picture, got none.")
    height, width = check_shape("images[0]", images[0], "H W 3").values()
    for picture in images:
        check_shape("images", picture, f"{height} {width} 3")
    numbers = [number for number, _ in _numbered(images, frames)]
    pictures = [require("PIL.Image").fromarray(np.ascontiguousarray(picture, np.uint8)) for picture in images]
    kind, tick = PICTURE_FORMATS[suffix]
    if kind == "GIF":
        pictures = [picture.quantize(255, dither=0) for picture in pictures]
    ticks = np.rint((np.array([*numbers, numbers[-1] + 1]) - numbers[0]) * 1000 / fps / tick).astype(int)
    durations = [max(int(count), 1) * tick for count in np.diff(ticks)]
    film = io.BytesIO()
    pictures[0].save(film, kind, save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=85)
    write_whole(path, film.getvalue())
