"""Quality of fits: distances between scan and body a frame, reasons of failure, tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from avatar.evaluation.scores import csv_text
from avatar.export.pictures import contact_sheet, frame_camera, render_mesh, render_points
from avatar.fitting.settings import QualityConfig
from avatar.geometry.closest import closest_on_mesh
from avatar.geometry.trees import build_tree
from avatar.io.npz import write_whole
from avatar.records import Mesh, PointCloud

SAMPLES = 3000  # scan points and body vertices that are measured
DEEP = 0.01  # metres inside the body from which a scan point counts as inside
NEAR = 0.10  # metres within which the scan lies near or over a covered vertex
SAME_SIDE = 0.2  # cosine between normals of a vertex and the scan over it
SCAN_COLOR = (0.25, 0.45, 0.70)


@dataclass(frozen=True)
class FitQuality:
    """How a body fits a scan; distances in metres, positive where the scan is outside the body."""

    outside_median: float  # of the scan points outside the body
    outside_p95: float  # 95th percentile of them
    inside_share: float  # share of the scan points more than 1 cm inside the body
    bare_median: float  # median distance, either side, of scan points at head, hands and feet
    covered_share: float  # share of the body with the scan within 10 cm, facing the same way
    objective: float  # of the registration's last stage

    def failures(self, limits: QualityConfig) -> tuple[str, ...]:
        """What misses its limit, with the figures; none for a good fit."""
        missed = (
            (self.inside_share > limits.inside, f"{self.inside_share:.1%} of the scan inside the body"),
            (np.isnan(self.bare_median), "no scan at head, hands and feet"),
            (self.bare_median > limits.bare, f"head, hands and feet {1000 * self.bare_median:.0f} mm from the scan"),
            (self.covered_share < limits.covered, f"the scan covers {self.covered_share:.0%} of the body"),
            (self.objective > limits.objective, f"objective {self.objective:.0f}"),
        )
        return tuple(text for miss, text in missed if miss)


def measure_fit(
    cloud: PointCloud, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, bare: np.ndarray, objective: float
) -> FitQuality:
    """Distances of a scan from a posed body ``(V, 3)`` with unit normals, of which ``bare (V,)`` are sure to be skin.

    On samples of the scan and of the vertices, spread by their order; NaN where there is nothing to measure.
    """
    some = np.linspace(0, len(cloud.points) - 1, min(SAMPLES, len(cloud.points))).astype(int)
    points = np.asarray(cloud.points, np.float64)[some]
    hits = closest_on_mesh(points, vertices, faces)
    signed = hits.signed_distances
    outside = signed[signed > 0]
    at_bare = bare[faces[hits.face_ids]].all(axis=1)
    ids = np.linspace(0, len(vertices) - 1, min(SAMPLES, len(vertices))).astype(int)
    tree = build_tree(np.asarray(cloud.points, np.float64))
    distances, nearest = tree.query(vertices[ids], k=min(8, len(cloud.points)))
    facing = np.einsum("vx,vkx->vk", normals[ids], np.asarray(cloud.normals)[nearest]) > SAME_SIDE
    return FitQuality(
        outside_median=float(np.median(outside)) if len(outside) else np.nan,
        outside_p95=float(np.percentile(outside, 95)) if len(outside) else np.nan,
        inside_share=float((signed < -DEEP).mean()),
        bare_median=float(np.median(np.abs(signed[at_bare]))) if at_bare.any() else np.nan,
        covered_share=float(((distances < NEAR) & facing).any(axis=1).mean()),
        objective=objective,
    )


def write_quality(path: Path, names: Sequence[str], qualities: Sequence[FitQuality], failed: Sequence[str]) -> None:
    """Writes a row a frame to a CSV, and the same beside it as Markdown, with the names of failed frames first."""
    columns = ["frame", *(field.name for field in fields(FitQuality)), "failed"]
    rows = [[name, *asdict(quality).values(), why] for name, quality, why in zip(names, qualities, failed)]
    write_whole(path, csv_text(columns, rows).encode())
    bad = [name for name, why in zip(names, failed) if why]
    lines = [f"{len(names)} frames fitted, {len(bad)} failed{': ' + ', '.join(bad) if bad else ''}.", ""]
    heads = (
        "frame",
        "outside, median mm",
        "outside, 95% mm",
        "inside",
        "bare skin mm",
        "covered",
        "objective",
        "failed",
    )
    lines += [f"| {' | '.join(heads)} |", "|---|" + "---:|" * 6 + "---|"]
    for name, q, why in zip(names, qualities, failed):
        cells = [name, f"{1000 * q.outside_median:.1f}", f"{1000 * q.outside_p95:.1f}", f"{q.inside_share:.1%}"]
        cells += [f"{1000 * q.bare_median:.1f}", f"{q.covered_share:.0%}", f"{q.objective:.0f}", why]
        lines.append(f"| {' | '.join(cells)} |")
    write_whole(path.with_suffix(".md"), ("\n".join(lines) + "\n").encode())


def picture_fit(cloud: PointCloud, body: Mesh, heading: float = 0.0, size: tuple[int, int] = (360, 540)) -> np.ndarray:
    """A picture ``(H, W, 3)`` uint8: scan, fitted body and both over each other, from the front and from the left.

    ``heading`` radians is where the person looks, about the vertical from +z towards +x.
    """
    camera, rows = frame_camera(np.concatenate([cloud.points, body.vertices]), size=size), []
    for view in ("front", "left"):
        seen = camera.seen_from(view)
        seen = replace(seen, azimuth=seen.azimuth + float(np.degrees(heading)))
        scan, mesh = render_points(cloud, seen, SCAN_COLOR), render_mesh(body, seen)
        rows.append([scan, mesh, ((scan.astype(np.uint16) + mesh) // 2).astype(np.uint8)])
    return contact_sheet(rows, ("front", "left"), ("scan", "fitted body", "both"))
