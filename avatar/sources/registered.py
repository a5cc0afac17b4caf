"""Scans without a fitted body, and the body that was registered to them: a source whose frames are fitted."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from avatar.body.families import BodyFamily, anny_family, fixed_family, smpl_family
from avatar.body.model import BodyModel
from avatar.body.packed import holds_template
from avatar.body.registry import body_of_file, canonical_pose
from avatar.checks import AvatarError, DataError, unknown_name
from avatar.data.splits import spaced_frames
from avatar.export.pictures import save_picture
from avatar.fitting.quality import picture_fit, write_quality
from avatar.fitting.settings import FittingConfig
from avatar.fitting.subjects import SubjectFit, fit_subject
from avatar.io.ledger import Ledger, digest_of
from avatar.io.locks import lock_folder
from avatar.io.raw_surface import RawSurface
from avatar.progress import tracked
from avatar.records import PointCloud
from avatar.sources.base import PosedScan, Source, SourceFrame
from avatar.sources.conversion import (
    ConvertConfig,
    chosen_frames,
    convert_outfit,
    converted_folder,
    posed_body,
    scan_arrays,
)

log = logging.getLogger(__name__)
SAMPLES = 40_000  # points that a body is registered to, of scans with more


@dataclass
class FitScansConfig(ConvertConfig):
    """A body fitted to every scan, and the outfit that they make with it."""

    minimal: list[str] = field(default_factory=list)  # frames in minimal clothing, which fix the shape; none if empty
    fitting: FittingConfig = field(default_factory=FittingConfig)
    pictures: int | None = None  # of fits beside their scans, evenly spaced; one a frame if null, none for 0


class Clouds(Sequence):
    """The oriented points of a source's frames, read when they are asked for.

    ``bare`` takes those of the meshes of another model's bodies under the scans instead. Raises `DataError` for a frame
    without one.
    """

    def __init__(self, source: Source, frames: Sequence[SourceFrame], bare: bool = False):
        self.source, self.frames, self.bare = source, frames, bare

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, number: int) -> PointCloud:
        frame = self.frames[number]
        posed = self.source.read(frame)
        if self.bare:
            mesh = self.source.body_mesh(frame)
            if mesh is None:
                raise DataError(frame.files[0], "expected the mesh of a body, as other frames have one, there is none.")
            posed = PosedScan(RawSurface(frame.files[0], mesh.vertices, mesh.faces))
        arrays = scan_arrays(posed, None, SAMPLES, frame.name)
        return PointCloud(arrays["scan_pc"], arrays["scan_n"])


class RegisteredSource(Source):
    """A source's frames that a body was fitted to, each with its split and with that body's pose."""

    def __init__(self, source: Source, frames: Sequence[SourceFrame], fit: SubjectFit):
        super().__init__(source.path, source.name, source.config)
        self.layout, self.source, self.fit = source.layout, source, fit
        self.fits = {frame.name: frame for frame in fit.frames}
        self.given = tuple(frame for frame in frames if not self.fits[frame.name].failed)

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        return {}  # no folder is of this layout

    @property
    def frames(self) -> tuple[SourceFrame, ...]:
        return self.given

    @cached_property
    def body(self) -> BodyModel:
        body = self.fit.body
        return body.with_canonical_pose(canonical_pose(self.config.body.canonical, body.joint_names))

    def read(self, frame: SourceFrame) -> PosedScan:
        fitted = self.fits[frame.name]
        return PosedScan(self.source.read(frame).scan, pose=fitted.pose, translation=fitted.translation)

    def made_of(self, frame: SourceFrame) -> list[str]:
        fitted = self.fits[frame.name]
        return [*super().made_of(frame), digest_of([fitted.pose.tolist(), fitted.translation.tolist()])]


def family_of(config: ConvertConfig) -> BodyFamily:
    """The bodies that are fitted: anny's, those of a converted SMPL, SMPL-H or SMPL-X model, or one of fixed shape."""
    path = config.body.path
    if path is None:
        return anny_family()
    if path.suffix.lower() != ".npz" or holds_template(path):
        return fixed_family(body_of_file(path, {}))
    return smpl_family(path)


def given_shape(config: ConvertConfig, family: BodyFamily) -> list[float] | None:
    """The shape of ``body.betas``, those that are not given 0; None where none are.

    Raises `AvatarError` for bodies without such a shape, or more numbers than the model has.
    """
    betas = list(config.body.betas)
    if not betas:
        return None
    most = 0 if config.body.path is None else len(family.names)
    if len(betas) > most:
        hint = "Hint: leave them out to have the shape estimated; SMPL's betas need its model as body.path."
        raise AvatarError(
            f"body.betas: expected at most {most} numbers for the body that is fitted, got {len(betas)}. {hint}"
        )
    return betas + [0.0] * (most - len(betas))


def register(source: Source, config: FitScansConfig, ledger: Ledger) -> RegisteredSource:
    """Fits one body to a source's scans (`fit_subject`); finished scans are kept in ``ledger``.

    Where meshes of a body of another model lie under the scans, it is fitted to those, skin to skin. Raises
    `AvatarError` for frames of ``minimal`` that are not there; otherwise errors as `fit_subject`.
    """
    frames = chosen_frames(source, config)
    names = [frame.name for frame in frames]
    for name in config.minimal:
        if name not in names:
            raise unknown_name("minimal", name, names[:20])
    minimal = [names.index(name) for name in config.minimal]
    family, fitting = family_of(config), config.fitting
    if bare := source.body is None and source.body_mesh(frames[0]) is not None:
        fitting = replace(fitting, clothing=False)
        log.info("%s: the body is fitted to the bodies' meshes under the scans.", source.path)
    shape = given_shape(config, family)
    fit = fit_subject(Clouds(source, frames, bare), family, fitting, names, minimal, shape, ledger)
    return RegisteredSource(source, frames, fit)


def write_report(folder: Path, source: RegisteredSource, frames: Sequence[SourceFrame], count: int | None) -> None:
    """Writes ``fits.csv``, ``fits.md`` and ``<frame>.png`` of ``count`` frames, evenly spaced, or of all."""
    fits = source.fit.frames
    write_quality(folder / "fits.csv", [f.name for f in fits], [f.quality for f in fits], [f.failed for f in fits])
    clouds = Clouds(source.source, frames)
    for number in tracked(spaced_frames(range(len(fits)), count), "pictures", unit="picture"):
        fitted = fits[number]
        posed = PosedScan(clouds.source.read(frames[number]).scan, pose=fitted.pose, translation=fitted.translation)
        picture = picture_fit(clouds[number], posed_body(source, posed), fitted.heading)
        save_picture(folder / f"{fitted.name}.png", picture)


def fit_outfit_body(source: Source, config: FitScansConfig) -> tuple[Path, tuple[str, ...]]:
    """Fits a body to an outfit's scans and converts them with it; gives the outfit's folder and frames that failed.

    Goes on with what is finished. ``<outfit>/fits`` holds the quality of every fit. Raises `DataError` where all fits
    failed, with the first one's reasons; otherwise errors as `register` and `convert_outfit`.
    """
    folder = converted_folder(source, config)
    with lock_folder(folder.parent / ".locks" / folder.name):
        registered = register(source, config, Ledger(folder / "fits"))
        frames = chosen_frames(source, config)
        write_report(folder / "fits", registered, frames, config.pictures)
        if not registered.frames:
            first = registered.fit.frames[0]
            problem = f"expected a body that fits, all {len(frames)} failed. The first, {first.name}: {first.failed}"
            raise DataError(source.path, problem, f"Pictures of them: {folder / 'fits'}")
        convert_outfit(registered, replace(config, start=0, stop=None, step=1, split=""))
    return folder, registered.fit.failed
