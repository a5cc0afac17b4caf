"""`mesh` and `export`: predictions to meshes, and sequences to animation files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from avatar.checks import AvatarError, DataError, check_name
from avatar.data.open_layout import OpenOutfit
from avatar.environment import prepared_process
from avatar.export.animation import write_animation, write_usd_meshes, write_usd_points
from avatar.export.meshing import MeshingReport, PoissonConfig, mesh_folder
from avatar.export.pictures import frame_camera, render_points
from avatar.export.rigged import write_rigged_glb
from avatar.io.meshes import read_mesh
from avatar.io.motions import read_motion
from avatar.io.points import read_points
from avatar.pipeline.methods import is_implicit, load_avatar
from avatar.pipeline.scores import meshes_folder, predictions_folder, run_outfits


@dataclass
class MeshConfig:
    """Poisson meshes of a run's predictions."""

    run: Path = Path("runs/closet/sample/dress/default")
    predictions: str = "test"  # the split or motion that was predicted
    formats: tuple[str, ...] = ("ply", "obj", "glb")
    frames: int | None = None  # this many, evenly spaced; all of them if null
    poisson: PoissonConfig = field(default_factory=PoissonConfig)

    def __post_init__(self):
        check_name("predictions", self.predictions)


@dataclass
class ExportConfig:
    """Animation files of a predicted sequence: USD caches of points and meshes, a rigged body, a moving picture."""

    run: Path = Path("runs/closet/sample/dress/default")
    predictions: str = "walk"  # the motion that was predicted
    fps: float = 30.0
    motion: Path | None = None  # the motion's file, for the rigged body's joint tracks
    data_root: Path | None = None  # where the data are now; where they were at training if null

    def __post_init__(self):
        check_name("predictions", self.predictions)


@prepared_process()
def mesh(config: MeshConfig) -> dict[Path, MeshingReport]:
    """Meshes the predictions of every outfit of a run into ``<run>/meshes/<split>/<outfit>``.

    Raises:
        AvatarError: after all frames, naming those that could not be meshed.
    """
    reports = {}
    avatar = load_avatar(config.run)
    for name in avatar.config.outfit:
        folder = predictions_folder(config.run, config.predictions, name)
        if not folder.is_dir():
            raise DataError(folder, "no predictions here.", "Run tools/predict.py first.")
        frames = spaced_frames(sorted(path.stem for path in folder.glob("*.ply")), config.frames)
        target = meshes_folder(config.run, config.predictions, name)
        if is_implicit(avatar):  # predicting has written its own surfaces
            reports[target] = MeshingReport(skipped=tuple(frames))
            continue
        reports[target] = mesh_folder(folder, target, config.formats, frames, config.poisson)
    failed = {frame: why for report in reports.values() for frame, why in report.failed.items()}
    if failed:
        frame, why = next(iter(failed.items()))
        raise AvatarError(f"{len(failed)} frames could not be meshed, the others were; {frame}: {why}")
    return reports


def spaced_frames(names: list[str], count: int | None) -> list[str]:
    """``count`` of the names, evenly spaced; all of them if None or fewer."""
    if count is None or count >= len(names):
        return names
    return [names[round(i * (len(names) - 1) / max(count - 1, 1))] for i in range(count)]


@prepared_process()
def export(config: ExportConfig) -> list[Path]:
    """Writes ``<run>/export/<motion>/<outfit>/{points.usdc, meshes.usdc, body.glb, preview.webp}``.

    Meshes are there when the sequence was meshed, joint tracks when its motion file is given.
    """
    avatar, written = load_avatar(config.run), []
    for outfit in run_outfits(avatar, config.data_root):
        folder = predictions_folder(config.run, config.predictions, outfit.name)
        paths = sorted(folder.glob("*.ply"))
        if not paths:
            raise DataError(folder, "no predictions here.", "Run tools/predict.py first.")
        target = config.run / "export" / config.predictions / outfit.name
        write_usd_points(target / "points.usdc", (read_points(path) for path in paths), config.fps)
        camera = frame_camera(read_points(paths[0]).points, "three_quarter", margin=0.2)
        images = [render_points(read_points(path), camera) for path in paths]
        write_animation(target / "preview.webp", images, config.fps)
        written += [target / "points.usdc", target / "preview.webp"]
        meshes = sorted((config.run / "meshes" / config.predictions / outfit.name).glob("*.ply"))
        if meshes:
            write_usd_meshes(target / "meshes.usdc", (read_mesh(path) for path in meshes), config.fps)
            written.append(target / "meshes.usdc")
        if isinstance(outfit, OpenOutfit):
            motion = read_motion(config.motion, config.fps) if config.motion else None
            write_rigged_glb(target / "body.glb", outfit.body, motion)
            written.append(target / "body.glb")
    return written
