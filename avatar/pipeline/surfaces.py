"""`mesh` and `export`: predictions to meshes, and sequences to animation files."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from avatar.checks import AvatarError, DataError, check_name
from avatar.data.splits import spaced_frames
from avatar.environment import prepared_process
from avatar.export.animation import write_animation, write_usd_meshes, write_usd_points
from avatar.export.meshing import MeshingReport, PoissonConfig, mesh_folder
from avatar.export.pictures import contact_sheet, cropped, frame_camera, render_points, save_picture
from avatar.export.rigged import write_rigged_glb
from avatar.io.ledger import Ledger, file_digest, keyed
from avatar.io.meshes import read_mesh, write_mesh
from avatar.io.motions import MotionConfig
from avatar.io.points import read_points
from avatar.io.textures import FILES as TEXTURE_FILES
from avatar.io.textures import TEXTURED, read_texture, write_textured_mesh
from avatar.pipeline.scores import meshes_folder, predicted_count, predicted_fps, predictions_folder, run_outfits
from avatar.progress import tracked
from avatar.records import Motion
from avatar.runs.texturing import FOLDER as TEXTURE
from avatar.runs.training import load_avatar

SOURCE = ("avatar.io.meshes", "avatar.io.textures")  # what writes meshes
log = logging.getLogger(__name__)

SHOWN = 8  # frames of a sequence side by side


@dataclass
class MeshConfig:
    """Poisson meshes of a run's predictions."""

    run: Path = Path("runs/closet/sample/dress/default")
    predictions: str = "test"  # the split or motion that was predicted
    formats: tuple[str, ...] = ("ply", "obj", "glb")  # of the files
    frames: int | None = None  # this many, evenly spaced; all of them if null
    poisson: PoissonConfig = field(default_factory=PoissonConfig)

    def __post_init__(self):
        check_name("predictions", self.predictions)


@dataclass
class ExportConfig(MotionConfig):
    """Animation files of a predicted sequence: USD caches of points and meshes, a rigged body, a moving picture."""

    run: Path = Path("runs/closet/sample/dress/default")
    predictions: str = "walk"  # the motion that was predicted
    fps: float | None = None  # frames a second; those that a motion was predicted at if null, 30 for frames of a split
    data_root: Path | None = None  # where the data are now; where they were at training if null

    def __post_init__(self):
        super().__post_init__()
        check_name("predictions", self.predictions)


@prepared_process()
def mesh(config: MeshConfig) -> dict[Path, MeshingReport]:
    """Meshes the predictions of every outfit of a run into ``<run>/meshes/<split>/<outfit>``. Frames that could not be
    meshed are an `AvatarError` after all of them. Where predicting has written meshes of the method's own, they are
    written in the other formats, with the run's texture where it has one (`convert_folder`).
    """
    avatar, reports = load_avatar(config.run), {}
    for name in avatar.config.outfit:
        folder = predictions_folder(config.run, config.predictions, name)
        if not folder.is_dir():
            raise DataError(folder, "no predictions here.", "Run tools/predict.py first.")
        frames = spaced_frames(sorted(path.stem for path in folder.glob("*.ply")), config.frames)
        target = meshes_folder(config.run, config.predictions, name)
        if avatar.method.makes_meshes:  # predicting has written its own surfaces
            reports[target] = convert_folder(config, target, frames)
            continue
        reports[target] = mesh_folder(folder, target, config.formats, frames, config.poisson)
    if failed := {frame: why for report in reports.values() for frame, why in report.failed.items()}:
        frame, why = next(iter(failed.items()))
        raise AvatarError(f"{len(failed)} frames could not be meshed, the others were; {frame}: {why}")
    return reports


def convert_folder(config: MeshConfig, folder: Path, frames: list[str]) -> MeshingReport:
    """Writes a folder's meshes ``<frame>.ply`` as the other formats, with the run's texture where it has their faces.

    PLY stays as it is; frames whose files are still right are not written again.
    """
    wanted, source = [ending for ending in config.formats if ending != "ply"], config.run / TEXTURE
    if not wanted:
        return MeshingReport(skipped=tuple(frames))
    meshes = [folder / f"{name}.ply" for name in frames]
    if missing := [path for path in meshes if not path.is_file()]:
        raise DataError(missing[0], "expected the mesh that predicting writes, there is none.", "Predict again.")
    texture = read_texture(source) if meshes and (source / TEXTURE_FILES[0]).is_file() else None
    if texture and not texture.fits(read_mesh(meshes[0])):
        hint = "Make it again: tools/texture.py."
        log.warning("%s: the texture is of other faces than %s, and is left out. %s", source, meshes[0], hint)
        texture = None
    pictured = [file_digest(source / name) for name in TEXTURE_FILES] if texture else None
    ledger, written, skipped = Ledger(folder), [], []
    for name, path in tracked(list(zip(frames, meshes)), "mesh files", unit="frame"):
        key = keyed(SOURCE, mesh=file_digest(path), texture=pictured, formats=wanted)
        if ledger.find(f"{name} formats", key):
            skipped.append(name)
            continue
        found, files = read_mesh(path), []
        for ending in wanted:
            target = folder / f"{name}.{ending}"
            if texture and target.suffix in TEXTURED:
                files += write_textured_mesh(target, found, texture)
            else:
                write_mesh(target, found)
                files.append(target)
        ledger.record(f"{name} formats", key, files)
        written.append(name)
    return MeshingReport(tuple(written), tuple(skipped))


@prepared_process()
def export(config: ExportConfig) -> list[Path]:
    """Writes ``<run>/export/<motion>/<outfit>/{points.usdc, meshes.usdc, body.glb, preview.webp, frames.png}``.
    Meshes are there when the sequence was meshed, joint tracks when its motion file is given. Frames are shown at the
    times of their numbers, eight of them side by side in ``frames.png``. Several sequences (those of a split) have a
    folder each, ``<outfit>/<sequence>``.
    """
    avatar, written, jobs = load_avatar(config.run), [], []
    for outfit in run_outfits(avatar, config.data_root):
        folder = predictions_folder(config.run, config.predictions, outfit.name)
        fps, motion = config.fps or predicted_fps(folder), None
        if config.motion and outfit.body is not None:
            motion = config.read_motion(outfit.body, fps)
            check_same_frames(config, folder, motion)
        jobs.append((outfit, folder, fps, motion))
    for outfit, folder, fps, motion in jobs:  # all motions were read by now
        meshes = meshes_folder(config.run, config.predictions, outfit.name)
        sequences = numbered_frames(path.stem for path in folder.glob("*.ply"))
        if not sequences:
            raise DataError(folder, "no predictions here.", "Run tools/predict.py first.")
        target = config.run / "export" / config.predictions / outfit.name
        for name, frames in sequences.items():
            place = target if len(sequences) == 1 else target / check_name("sequence", name)
            written += export_sequence(folder, meshes, frames, fps, place)
        if outfit.body is not None:
            write_rigged_glb(target / "body.glb", outfit.body, motion)
            written.append(target / "body.glb")
    return written


def check_same_frames(config: ExportConfig, folder: Path, motion: Motion) -> None:
    """Refuses a motion of another number of frames than was predicted, at the same rate."""
    predicted, read = predicted_count(folder), len(motion.poses)
    if predicted is not None and predicted != read and motion.fps == predicted_fps(folder):
        problem = f"expected the {predicted} frames that were predicted, got {read}."
        raise DataError(config.motion, problem, "Give start=, stop= and step= as to predict.")


def numbered_frames(names: Iterable[str]) -> dict[str, dict[int, str]]:
    """Frames ``<sequence>.<number>`` as sequence, number and name, in order; those without a number are counted."""
    sequences: dict[str, dict[int, str]] = {}
    for place, name in enumerate(sorted(names)):
        sequence, _, digits = name.rpartition(".")
        frames = sequences.setdefault((digits.isdecimal() and sequence) or "frames", {})
        number = int(digits) if digits.isdecimal() else place
        if number in frames:
            raise AvatarError(f"predictions: expected one frame a number, got {frames[number]} and {name}.")
        frames[number] = name
    return {sequence: dict(sorted(frames.items())) for sequence, frames in sequences.items()}


def export_sequence(folder: Path, meshes: Path, frames: dict[int, str], fps: float, target: Path) -> list[Path]:
    """Writes the points, the preview and, where there are any, the meshes of one sequence; gives the files."""
    clouds = {number: folder / f"{name}.ply" for number, name in frames.items()}
    write_usd_points(target / "points.usdc", map(read_points, clouds.values()), fps, list(clouds))
    camera = frame_camera(read_points(clouds[min(clouds)]).points, "three_quarter", margin=0.2)
    images = [render_points(read_points(path), camera) for path in clouds.values()]
    write_animation(target / "preview.webp", images, fps, list(clouds))
    save_picture(target / "frames.png", contact_sheet([cropped(spaced_frames(images, SHOWN))]))
    surfaces = {number: meshes / f"{name}.ply" for number, name in frames.items()}
    surfaces = {number: path for number, path in surfaces.items() if path.is_file()}
    made = ["points.usdc", "preview.webp", "frames.png"]
    if surfaces:
        write_usd_meshes(target / "meshes.usdc", map(read_mesh, surfaces.values()), fps, list(surfaces))
        made.append("meshes.usdc")
    return [target / name for name in made]
