"""`template`: an outfit's clothed template from its canonical scans, with pictures and a report of faults."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import torch

from avatar.canonical.refinement import pose_mesh
from avatar.data.splits import spaced_frames
from avatar.environment import prepared_process
from avatar.export.pictures import (
    Camera,
    contact_sheet,
    frame_camera,
    load_pyvista,
    render_mesh,
    render_points,
    save_picture,
)
from avatar.io.clothed_templates import read_clothed_template
from avatar.progress import tracked
from avatar.records import Mesh, PointCloud, Template
from avatar.runs.templating import TemplateConfig, make_template, skin_colors, template_scans

log = logging.getLogger(__name__)
PICTURE = (640, 640)
FROM_BELOW = -35.0  # degrees
HEAD_HEIGHT = 0.36  # metres shown of a head
VIEWS = ("front", "left", "back")


@prepared_process()
def template(config: TemplateConfig) -> Path:
    """Makes or resumes an outfit's clothed template, draws it, and logs its faults; gives its folder.

    Raises:
        AvatarError: before any work, when pictures are asked for on a machine that cannot draw.
    """
    if config.pictures:
        load_pyvista()
    folder = make_template(config)
    if config.pictures:
        draw_template(config, folder)
    for fault in json.loads((folder / "report.json").read_text())["faults"]:
        log.warning("template: %s", fault)
    return folder


def draw_template(config: TemplateConfig, folder: Path) -> list[Path]:
    """Writes ``pictures/template.png`` (all sides, from below, the head) and ``posed.png`` (beside scans)."""
    outfit = config.find_outfit()
    clothed = read_clothed_template(folder / "template.npz")
    rest = Mesh(clothed.vertices, clothed.faces, skin_colors(clothed))
    whole = frame_camera(rest.vertices, size=PICTURE)
    below = replace(whole, elevation=FROM_BELOW)
    cameras = [*(whole.seen_from(view) for view in VIEWS), below, below.seen_from("back"), head_camera(outfit.template)]
    rows = [[render_mesh(rest, camera) for camera in cameras]]
    written = [folder / "pictures" / "template.png", folder / "pictures" / "posed.png"]
    save_picture(written[0], contact_sheet(rows, (), (*VIEWS, "from below", "from below, back", "head")))
    names, scans = template_scans(config.find_run(outfit), outfit)
    chosen = spaced_frames(names, config.pictures)
    bind, rows = outfit.template.canonical_from_bind, []
    values = torch.from_numpy(clothed.weights)
    for name in tracked(chosen, "pictures", unit="picture"):
        scan = scans[names.index(name)]
        points, normals = scan.posed
        posed = pose_mesh(torch.from_numpy(clothed.vertices), values, scan.joint_transforms, bind).numpy()
        camera = frame_camera(points, size=PICTURE)
        row = []
        for view in ("front", "back"):
            row.append(render_points(PointCloud(points, normals), camera.seen_from(view), "normals"))
            row.append(render_mesh(Mesh(posed, clothed.faces), camera.seen_from(view), skin_colors(clothed)))
        rows.append(row)
    save_picture(written[1], contact_sheet(rows, chosen, ("scan", "template", "scan, back", "template, back")))
    return written


def head_camera(body: Template) -> Camera:
    """A camera on the head, from three quarters."""
    top = body.vertices[body.vertices[:, 1].argmax()].numpy()
    center = (float(top[0]), float(top[1]) - HEAD_HEIGHT / 2 + 0.02, float(top[2]))
    return Camera(center, HEAD_HEIGHT, 35.0, 0.0, PICTURE)
