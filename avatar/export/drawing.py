"""How pictures are drawn: an orthographic camera, one soft light computed from the normals, discs for points.

All shading is computed here and drawn unlit by pyvista, so that points and meshes of one frame look alike and a
picture does not depend on a renderer's idea of light.
"""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from avatar.checks import AvatarError, check_finite, require, unknown_name
from avatar.geometry.trees import build_tree
from avatar.invocation import install_line

AZIMUTHS = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0, "side": 90.0, "three_quarter": 35.0}
BACKGROUND = (0.957, 0.957, 0.945)
KEY_LIGHT = np.array([-0.45, 0.65, 0.61])  # camera frame: from the upper left, before the person
SHADOW, SHADOW_TINT = 0.42, np.array([0.93, 0.96, 1.05])  # share of light left in shadow, and its cooler tone
DISC_CORNERS = 6
DISC_NEIGHBOUR = 7  # the point itself counted
DISC_SPACING = 1.0  # disc radius in distances to that neighbour: discs overlap, rims are not thickened
GL_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libGLX.so.0")


@dataclass(frozen=True)
class Camera:
    """An orthographic camera: who it looks at and from where. Use one for all methods of one frame.

    ``center`` the point in the middle of the picture, metres; ``extent`` metres from its top to its bottom;
    ``azimuth`` degrees around the vertical, 0 before the person and 90 at the person's left; ``elevation``
    degrees above the horizon; ``size`` pixels, width and height.
    """

    center: tuple[float, float, float]
    extent: float
    azimuth: float = 0.0
    elevation: float = 0.0
    size: tuple[int, int] = (640, 960)

    @property
    def axes(self) -> np.ndarray:
        """``(3, 3)`` rows right, up and towards the viewer, in the world."""
        turn, lift = np.radians([self.azimuth, self.elevation])
        towards = np.array([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)])
        right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        return np.stack([right, np.cross(towards, right), towards])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates ``(N, 2)``, column and row from the upper left corner, of ``(N, 3)`` points."""
        across, up, _ = self.axes @ (np.asarray(points, np.float64) - self.center).T
        scale = self.size[1] / self.extent
        return np.stack([self.size[0] / 2 + across * scale, self.size[1] / 2 - up * scale], axis=1)

    def seen_from(self, view: str) -> Camera:
        """The same framing from front, left, back, right, side (the left) or three_quarter."""
        return replace(self, azimuth=_azimuth(view))


def frame_camera(
    points: np.ndarray,
    view: str = "front",
    size: tuple[int, int] = (640, 960),
    margin: float = 0.05,
    elevation: float = 0.0,
) -> Camera:
    """A camera that shows all of ``points (..., 3)`` from a named view, with a margin as share of the picture.

    They stay in the picture when it turns around them (`Camera.seen_from`); frames of a sequence, stacked, get one
    camera for all.
    """
    cloud = np.asarray(points, np.float64).reshape(-1, 3)
    if not len(cloud):
        raise AvatarError("points: expected at least one to frame a picture by, got none.")
    check_finite("points", cloud)
    center = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    around = np.hypot(*(cloud - center)[:, [0, 2]].T).max()
    upwards = np.abs(cloud[:, 1] - center[1]).max()
    lift = np.radians(elevation)
    up = upwards * np.cos(lift) + around * np.abs(np.sin(lift))
    extent = 2 * max(up, around * size[1] / size[0], 1e-3) / (1 - 2 * margin)
    return Camera(tuple(center.tolist()), float(extent), _azimuth(view), elevation, size)


def _azimuth(view: str) -> float:
    if view not in AZIMUTHS:
        raise unknown_name("view", view, AZIMUTHS)
    return AZIMUTHS[view]


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
    return DISC_SPACING * np.maximum(np.clip(spacing, 0.7 * typical, 1.5 * typical), 1e-4)


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
        center = np.array(camera.center)
        plotter.camera_position = [center + towards * camera.extent * 2, center, up]
        plotter.enable_parallel_projection()
        plotter.parallel_scale = camera.extent / 2
        plotter.reset_camera_clipping_range()
        return np.ascontiguousarray(plotter.screenshot(return_img=True)[..., :3])
    finally:
        plotter.close()


def load_pyvista() -> ModuleType:
    """pyvista, once it is known that this machine can draw: VTK without a GL library ends the whole process."""
    if sys.platform == "linux":
        if not any(_loads(name) for name in GL_LIBRARIES):
            raise AvatarError(
                f"pictures need one of {', '.join(GL_LIBRARIES)}, and this machine has none. "
                f"Run: {install_line('pyvista')}"
            )
        if "DISPLAY" not in os.environ:
            os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    return require("pyvista")


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
