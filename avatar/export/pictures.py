"""Pictures of point clouds and meshes of people, and sheets of them: comparable across methods and frames.

An orthographic camera, one soft light computed from the normals, discs for points. All shading is computed here and
drawn unlit by pyvista, so that a picture does not depend on a renderer's idea of light.
"""

from __future__ import annotations

import ctypes
import importlib
import io
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from avatar.checks import AvatarError, check_finite, check_oriented, check_shape, check_suffix, require, unknown_name
from avatar.geometry.surface import vertex_normals
from avatar.geometry.trees import build_tree
from avatar.invocation import install_line
from avatar.io.meshes import check_mesh
from avatar.io.npz import write_whole
from avatar.records import Mesh, PointCloud

AZIMUTHS = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0, "side": 90.0, "three_quarter": 35.0}
BACKGROUND = (0.957, 0.957, 0.945)
KEY_LIGHT = np.array([-0.45, 0.65, 0.61])  # camera frame: from the upper left, before the person
SHADOW, SHADOW_TINT = 0.42, np.array([0.93, 0.96, 1.05])  # share of light left in shadow, and its cooler tone
DISC_CORNERS = 6
DISC_NEIGHBOUR = 7  # the point itself counted; its distance is the radius: discs overlap, boundaries stay thin
GL_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libGLX.so.0")
CLAY = (0.80, 0.74, 0.68)
BACK_FACE = 0.42  # brightness of surfaces seen from behind
INK = (52, 52, 56)
PAPER = tuple(round(channel * 255) for channel in BACKGROUND)
PICTURE_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


@dataclass(frozen=True)
class Camera:
    """An orthographic camera: who it looks at and from where. Use one for all methods of one frame."""

    center: tuple[float, float, float]  # in the middle of the picture, metres
    extent: float  # metres from its top to its bottom
    azimuth: float = 0.0  # degrees around the vertical, 0 before the person and 90 at the person's left
    elevation: float = 0.0  # degrees above the horizon
    size: tuple[int, int] = (640, 960)  # pixels, width and height

    @property
    def axes(self) -> np.ndarray:
        """``(3, 3)`` rows right, up and towards the viewer, in the world."""
        turn, lift = np.radians([self.azimuth, self.elevation])
        right = np.array([np.cos(turn), 0, -np.sin(turn)])
        towards = np.array([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)])
        return np.stack([right, np.cross(towards, right), towards])

    def seen_from(self, view: str) -> Camera:
        """The same framing from front, left, back, right, side (the left) or three_quarter."""
        if view not in AZIMUTHS:
            raise unknown_name("view", view, AZIMUTHS)
        return replace(self, azimuth=AZIMUTHS[view])


def frame_camera(
    points: np.ndarray, view: str = "front", size: tuple[int, int] = (640, 960), margin: float = 0.05
) -> Camera:
    """A camera that shows all of ``points (..., 3)`` from a named view, with a margin as share of the picture.

    They stay in the picture when it turns around them (`Camera.seen_from`). Raises `AvatarError` for no points.
    """
    cloud = np.asarray(points, np.float64).reshape(-1, 3)
    if not len(cloud):
        raise AvatarError("points: expected at least one to frame a picture by, got none.")
    check_finite("points", cloud)
    center = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    around = np.hypot(*(cloud - center)[:, [0, 2]].T).max()
    up = np.abs(cloud[:, 1] - center[1]).max()
    extent = 2 * max(up, around * size[1] / size[0], 1e-3) / (1 - 2 * margin)
    return Camera(tuple(center.tolist()), float(extent), size=size).seen_from(view)


def shade(normals: np.ndarray, colors: str | tuple | np.ndarray, camera: Camera) -> np.ndarray:
    """Lit RGB ``(N, 3)``: a soft key light that never goes black, or the normals themselves as colours."""
    seen = normals @ camera.axes.T
    if isinstance(colors, str):
        if colors != "normals":
            raise AvatarError(f"colors: expected 'normals' or RGB in [0, 1], got {colors!r}.")
        return np.clip(seen * 0.5 + 0.5, 0, 1) * (0.75 + 0.25 * np.clip(seen[:, 2:], 0, 1))
    base = np.asarray(colors, np.float64)
    check_finite("colors", base)
    if base.shape not in ((3,), normals.shape) or base.min() < 0 or base.max() > 1:
        raise AvatarError(
            f"colors: expected 'normals', one RGB colour or {normals.shape} RGB values, all in [0, 1], "
            f"got shape {base.shape} from {base.min():.3g} to {base.max():.3g}."
        )
    wrapped = np.clip((seen @ (KEY_LIGHT / np.linalg.norm(KEY_LIGHT)) + 0.35) / 1.35, 0, 1)[:, None]
    light = wrapped + (1 - wrapped) * SHADOW * SHADOW_TINT
    return np.clip(base * light * (0.88 + 0.12 * np.clip(seen[:, 2:], 0, 1)), 0, 1)


def disc_radii(points: np.ndarray) -> np.ndarray:
    """Disc sizes ``(N,)`` that close to a surface at the points' own spacing, yet leave real gaps to be seen."""
    distances, _ = build_tree(points).query(points, k=min(DISC_NEIGHBOUR, len(points)))
    spacing = distances.reshape(len(points), -1)[:, -1]
    typical = np.median(spacing)
    return np.maximum(np.clip(spacing, 0.7 * typical, 1.5 * typical), 1e-4)


def discs(points: np.ndarray, normals: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Corners ``(N, DISC_CORNERS, 3)`` of discs around the points, at right angles to their normals."""
    aside = np.eye(3)[np.abs(normals).argmin(axis=1)]  # the axis furthest from the normal
    first = np.cross(normals, aside)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    turns = np.arange(DISC_CORNERS) * (2 * np.pi / DISC_CORNERS)
    spread = np.cos(turns)[:, None] * first[:, None] + np.sin(turns)[:, None] * second[:, None]
    return points[:, None] + radii[:, None, None] * spread


def draw(layers: list[tuple[Any, np.ndarray, str | None]], camera: Camera) -> np.ndarray:
    """Draws (pyvista surface, RGB per point, culled side) layers without further lighting, anti-aliased."""
    plotter = load_pyvista().Plotter(off_screen=True, window_size=camera.size, lighting="none")
    try:
        plotter.set_background(BACKGROUND)
        for surface, shades, culling in layers:
            surface.point_data["shades"] = np.rint(shades * 255).astype(np.uint8)
            plotter.add_mesh(surface, scalars="shades", rgb=True, lighting=False, culling=culling)
        plotter.enable_anti_aliasing("ssaa")
        _, up, towards = camera.axes
        plotter.camera_position = [camera.center + towards * camera.extent * 2, camera.center, up]
        plotter.enable_parallel_projection()
        plotter.parallel_scale = camera.extent / 2
        plotter.reset_camera_clipping_range()
        return np.ascontiguousarray(plotter.screenshot(return_img=True)[..., :3])
    finally:
        plotter.close()


def load_pyvista() -> ModuleType:
    """pyvista, once it is known that this machine can draw: VTK without a GL library ends the whole process.

    Mesa and triton each bring an LLVM, and loading triton's after VTK has drawn ends the process as well, whoever asks
    for it (torch does for roma); so triton, where there is one, is loaded first.
    """
    with suppress(ImportError):
        importlib.import_module("triton")
    if sys.platform == "linux":
        if not any(_loads(name) for name in GL_LIBRARIES):
            names, line = ", ".join(GL_LIBRARIES), install_line("pyvista")
            raise AvatarError(f"pictures need one of {names}, and this machine has none. Run: {line}")
        if "DISPLAY" not in os.environ:
            os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    return require("pyvista")


def _loads(library: str) -> bool:
    try:
        return bool(ctypes.CDLL(library))
    except OSError:
        return False


def render_points(
    cloud: PointCloud, camera: Camera | None = None, colors: str | tuple | np.ndarray = "normals"
) -> np.ndarray:
    """A picture ``(H, W, 3)`` uint8 of oriented points as overlapping discs; seen from behind they are darker.

    The camera frames the cloud from the front if None. ``colors`` are "normals" (in the camera's frame), one RGB
    colour, or ``(N, 3)`` RGB, all in [0, 1]. Raises `AvatarError` on wrong shapes, non-finite values, or when pictures
    cannot be made on this machine.
    """
    check_oriented(cloud.points, cloud.normals)
    points, normals = (np.asarray(values, np.float64) for values in (cloud.points, cloud.normals))
    camera = camera or frame_camera(points)
    facing = normals @ camera.axes[2]
    shades = shade(np.where(facing[:, None] < 0, -normals, normals), colors, camera)
    shades *= np.where(facing < 0, BACK_FACE, 1.0)[:, None]
    corners = discs(points, normals, disc_radii(points))
    faces = np.arange(corners.shape[0] * DISC_CORNERS).reshape(-1, DISC_CORNERS)
    surface = load_pyvista().PolyData.from_regular_faces(corners.reshape(-1, 3), faces)
    return draw([(surface, shades.repeat(DISC_CORNERS, axis=0), None)], camera)


def render_mesh(mesh: Mesh, camera: Camera | None = None, colors: str | tuple | np.ndarray | None = None) -> np.ndarray:
    """A picture ``(H, W, 3)`` uint8 of a mesh, smooth shaded; the inside of an open surface is darker.

    Camera, colours and errors as `render_points`, with colours a vertex: the mesh's own or clay if None.
    """
    check_mesh(mesh)
    camera = camera or frame_camera(mesh.vertices)
    if colors is None:
        colors = CLAY if mesh.colors is None else mesh.colors
    vertices = np.asarray(mesh.vertices, np.float64)
    normals = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(mesh.faces)).numpy()
    surface = load_pyvista().PolyData.from_regular_faces(vertices, mesh.faces)
    outside, inside = shade(normals, colors, camera), shade(-normals, colors, camera) * BACK_FACE
    return draw([(surface, outside, "back"), (surface.copy(), inside, "front")], camera)


def render_error(cloud: PointCloud, errors: np.ndarray, max_error: float, camera: Camera | None = None) -> np.ndarray:
    """A picture, as `render_points`, of points coloured by their errors ``(N,)``, metres, from 0 to ``max_error``."""
    check_shape("errors", errors, "N", N=len(cloud.points))
    check_finite("errors", errors)
    if not max_error > 0:
        raise AvatarError(f"max_error: expected a positive number of metres, got {max_error}.")
    return render_points(cloud, camera, map_colors(errors / max_error))


def map_colors(values: np.ndarray) -> np.ndarray:
    """RGB colours ``(..., 3)`` in [0, 1] of values in [0, 1]; values outside take the colour of the nearer end."""
    return require("matplotlib").colormaps["turbo"](np.clip(values, 0, 1))[..., :3]


def cropped(pictures: Sequence[np.ndarray], margin: int = 8) -> list[np.ndarray]:
    """Pictures ``(H, W, 3)`` of one size without the border that is background in all of them, but for a margin."""
    drawn = np.any([(picture != np.array(PAPER, np.uint8)).any(axis=2) for picture in pictures], axis=0)
    rows, columns = (np.flatnonzero(drawn.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return list(pictures)
    top, bottom, left, right = rows[0] - margin, rows[-1] + margin, columns[0] - margin, columns[-1] + margin
    return [picture[max(top, 0) : bottom + 1, max(left, 0) : right + 1] for picture in pictures]


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray]],
    row_labels: Sequence[str] = (),
    column_labels: Sequence[str] = (),
    gap: int = 8,
) -> np.ndarray:
    """One picture of many ``(H, W, 3)`` uint8, in rows and columns ``gap`` pixels apart, with labels left and on top.

    A short row ends in empty places. Raises `AvatarError` when pictures differ in size, or labels are neither one a row
    or column nor none.
    """
    pictures = [picture for row in rows for picture in row]
    if not pictures:
        raise AvatarError("rows: expected at least one picture, got none.")
    for picture in pictures:
        _check_picture("rows", picture)
        if picture.shape != pictures[0].shape:
            raise AvatarError(f"rows: expected pictures of one size, got {picture.shape} and {pictures[0].shape}.")
    columns = max(len(row) for row in rows)
    for name, labels, count in ("row", row_labels, len(rows)), ("column", column_labels, columns):
        if labels and len(labels) != count:
            raise AvatarError(f"{name}_labels: expected {count} or none, got {len(labels)}.")
    height, width = pictures[0].shape[:2]
    letter = max(12, height // 32)
    left, top = (2 * letter if row_labels else 0), (2 * letter if column_labels else 0)
    across, down = (
        [left + j * (width + gap) for j in range(columns)],
        [top + i * (height + gap) for i in range(len(rows))],
    )
    sheet = np.full((down[-1] + height, across[-1] + width, 3), PAPER, np.uint8)
    for y, row in zip(down, rows):
        for x, picture in zip(across, row):
            sheet[y : y + height, x : x + width] = picture
    for x, label in zip(across, column_labels):
        sheet[:top, x : x + width] = _label(label, width, top, letter)
    for y, label in zip(down, row_labels):
        sheet[y : y + height, :left] = np.rot90(_label(label, height, left, letter))
    return sheet


def color_bar(max_error: float, height: int = 960) -> np.ndarray:
    """The scale that belongs to `render_error`: a strip from 0 to ``max_error`` metres, written in millimetres."""
    letter = max(12, height // 32)
    bar = np.full((height, 5 * letter, 3), PAPER, np.uint8)
    ramp = map_colors(np.linspace(1, 0, height - 3 * letter))
    bar[2 * letter : height - letter, letter : 2 * letter] = np.rint(ramp * 255)[:, None]
    for share in (0, 0.5, 1):
        y = round(2 * letter + (1 - share) * (height - 3 * letter - 1))
        text = _label(f"{share * max_error * 1000:.3g}", 3 * letter, 2 * letter, letter)
        bar[max(0, y - letter) : y + letter, 2 * letter :] = text[: min(height, y + letter) - max(0, y - letter)]
    bar[: round(1.2 * letter), : 2 * letter] = _label("mm", 2 * letter, round(1.2 * letter), letter)
    return bar


def save_picture(path: str | Path, picture: np.ndarray) -> None:
    """Writes a ``(H, W, 3)`` uint8 picture as PNG or JPEG, whole or not at all; equal pictures, equal bytes."""
    path = Path(path)
    kind = PICTURE_FORMATS[check_suffix(path, PICTURE_FORMATS, "a picture")]
    _check_picture("picture", picture)
    encoded = io.BytesIO()
    require("PIL.Image").fromarray(picture).save(encoded, format=kind, quality=92)
    write_whole(path, encoded.getvalue())


def _check_picture(name: str, picture: np.ndarray) -> None:
    check_shape(name, picture, "H W 3")
    if picture.dtype != np.uint8:
        raise AvatarError(f"{name}: expected uint8 pictures, got {picture.dtype}.")


def _label(text: str, width: int, height: int, letter: int) -> np.ndarray:
    """Text in the middle of a strip of paper, smaller where it would not fit."""
    strip = require("PIL.Image").new("RGB", (width, height), PAPER)
    pen = require("PIL.ImageDraw").Draw(strip)
    font = require("PIL.ImageFont").load_default
    taken = pen.textlength(text, font=font(letter))
    pen.text((width / 2, height / 2), text, fill=INK, font=font(letter * min(1, width / max(taken, 1))), anchor="mm")
    return np.asarray(strip)
