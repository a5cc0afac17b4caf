"""`texture`: the colours of a run's training scans baked onto its mesh, with pictures of test poses."""

from __future__ import annotations

import io
import json
import logging
from pathlib import Path

import numpy as np

from avatar.checks import require
from avatar.environment import prepared_process
from avatar.export.pictures import contact_sheet, frame_camera, load_pyvista, render_mesh, render_points, save_picture
from avatar.export.texturing import Unwrapped, fine_mesh
from avatar.io.textures import read_texture
from avatar.progress import tracked
from avatar.records import Mesh, PointCloud
from avatar.runs.texturing import TextureConfig, make_texture, open_run, spaced

log = logging.getLogger(__name__)
PICTURE = (640, 960)


@prepared_process()
def texture(config: TextureConfig) -> Path:
    """Bakes a run's texture, draws it on test poses, and logs its errors; gives its folder.

    Raises:
        AvatarError: before any work, when pictures are asked for on a machine that cannot draw.
    """
    drawn = min(config.pictures, config.scored)
    if drawn:
        load_pyvista()
    folder = make_texture(config)
    if drawn:
        draw_textured(config, folder, drawn)
    for name, found in json.loads((folder / "report.json").read_text()).get("errors", {}).items():
        errors = ", ".join(f"{way} {row['error']:.4f}" for way, row in found.items() if isinstance(row, dict))
        log.info("texture: mean difference of colours, %s: %s", name, errors)
    return folder


def draw_textured(config: TextureConfig, folder: Path, count: int) -> list[Path]:
    """Writes ``pictures/<frame>.png``: a test frame's coloured scan beside the textured prediction, front and back."""
    opened, stored = open_run(config), read_texture(folder)
    if not opened.outfit.has_frames("test"):
        return []
    image = np.asarray(require("PIL.Image").open(io.BytesIO(stored.png)).convert("RGB"))
    unwrapped = Unwrapped(stored.uv, stored.uv_faces, image.shape[1::-1], config.texel)
    written = []
    for name in tracked(spaced(spaced(opened.outfit.frames("test"), config.scored), count), "pictures", unit="picture"):
        vertices, scan = opened.load("test", name)
        mesh = fine_mesh(Mesh(vertices, stored.faces), unwrapped, image, opened.clothed.visible_faces)
        camera = frame_camera(scan.points, size=PICTURE)
        cloud, row = PointCloud(scan.points, scan.normals), []
        for view in ("front", "back"):
            row.append(render_points(cloud, camera.seen_from(view), scan.colors))
            row.append(render_mesh(mesh, camera.seen_from(view)))
        written.append(folder / "pictures" / f"{name}.png")
        save_picture(written[-1], contact_sheet([row], (), ("scan", "textured mesh", "scan, back", "mesh, back")))
    return written
