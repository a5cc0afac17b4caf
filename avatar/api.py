"""Python interface: trained avatars posed by arrays or motions, surfaces as arrays, training, scores (docs/python.md).

Units are metres and radians, y is up; poses are axis-angle, relative to the parent joint and to the T-pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.checks import AvatarError, check_shape
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.evaluation.metrics import Comparison, find_metrics
from avatar.export.meshing import PoissonConfig, PoissonMesher
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.meshes import write_mesh
from avatar.io.motions import move_body, read_body_motion
from avatar.io.points import write_points
from avatar.methods.settings import RunConfig
from avatar.records import Mesh, Motion, PointCloud, Scan, Surface
from avatar.runs.training import load_avatar, train

__all__ = ["Avatar", "Mesh", "Motion", "PointCloud", "RunConfig", "Surface", "run_settings", "score", "to_mesh"]
__all__ += ["train", "write_mesh", "write_points"]
METRICS = ("cd_point", "normal_l1_mean", "f_score_5mm")


class Avatar:
    """A trained avatar: dressed surfaces of its outfits in any pose."""

    def __init__(
        self, run: Path | str, data_root: Path | str | None = None, checkpoint: str = "last", device: str = "auto"
    ):
        """Loads the avatar in a run's folder, its ``checkpoint`` ``last`` or ``best``, for ``auto``, ``cpu``, ``cuda``.

        ``data_root`` is where the data are now; where they were at training if None. Raises `DataError` when the folder
        is no finished run, or a file in it is damaged.
        """
        self.trained = load_avatar(Path(run), checkpoint, device)
        config = self.trained.config
        self._outfits = replace(config, data_root=Path(data_root or config.data_root)).outfits()

    @property
    def outfits(self) -> tuple[str, ...]:
        """The names of the outfits that it was trained on."""
        return self.trained.config.outfit

    def joint_names(self, outfit: str | None = None) -> tuple[str, ...]:
        """The names of the J joints that a pose has a row for, the root first."""
        return tuple(self._find(outfit).posable_body().joint_names)

    def pose(
        self,
        pose: np.ndarray,
        translation: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        outfit: str | None = None,
        points: int = 50_000,
        surface: ExtractionConfig | None = None,
    ) -> Surface:
        """The dressed surface of an outfit, the first if None, in one pose.

        ``pose (J, 3)`` axis-angle, radians; ``translation (3,)`` metres; 1,000 to 400,000 ``points``; ``surface`` the
        resolution of an implicit avatar's. Raises `AvatarError` for an unknown outfit, or a pose of other joints;
        `DataError` for an outfit whose body cannot be posed.
        """
        pose, translation = np.asarray(pose, np.float32)[None], np.asarray(translation, np.float32)[None]
        return next(self.animate(Motion(pose, translation, 30.0, "pose"), outfit, points=points, surface=surface))

    def animate(
        self,
        motion: Motion | Path | str,
        outfit: str | None = None,
        fps: float | None = None,
        points: int = 50_000,
        surface: ExtractionConfig | None = None,
        up: str | None = None,
        units: str | None = None,
        joints: Path | str | None = None,
    ) -> Iterator[Surface]:
        """The dressed surface in every frame of a motion, one after another; see `pose`.

        A motion is an AMASS ``.npz``, a BVH file, one of our own, or arrays: of the body's own J joints, or of the 22
        of SMPL, whose rotations then go to the joints of those names. A file is resampled to ``fps`` frames a second,
        its own if None; ``up``, ``units`` and ``joints`` (a map file) give what it does not say itself (docs/data.md).
        The points of a point method keep their order over time.
        """
        data = self._find(outfit)
        body = data.posable_body()
        if not isinstance(motion, Motion):
            named = None if joints is None else Path(joints)
            motion = read_body_motion(Path(motion), body, fps, up, units, joints=named)
        else:
            motion = self._own_joints(motion, body)
        dress = self.trained.method.predictor(self.trained, data.name, points, surface or ExtractionConfig())
        for pose, translation in zip(motion.poses, motion.translations, strict=True):
            with prepared_process():  # for each frame, as the caller has the process in between
                surface = dress(data.fit_pose(pose, translation))
            yield surface

    def _own_joints(self, motion: Motion, body: BodyModel) -> Motion:
        """A motion of arrays as one of the body's joints, after a check of their shapes."""
        frames = check_shape("poses", motion.poses, "T J 3")["T"]
        check_shape("translations", motion.translations, "T 3", T=frames)
        joints, own = motion.poses.shape[1], len(body.parents)
        if joints not in (own, len(SMPL_JOINTS)):
            raise AvatarError(
                f"poses: expected (T, {own}, 3), the body's joints, or (T, {len(SMPL_JOINTS)}, 3), those of SMPL, got "
                f"{tuple(motion.poses.shape)}. Hint: joint_names() has the body's."
            )
        return motion if joints == own else move_body(motion, body)

    def garment(self, outfit: str | None = None, points: int = 50_000) -> PointCloud | None:
        """The explicit garment template of an outfit in the canonical pose; None for a method without one."""
        return self.trained.method.garment(self.trained, self._find(outfit).name, points)

    def _find(self, outfit: str | None) -> Outfit:
        return self._outfits[0 if outfit is None else self.trained.outfit_index(outfit)]


def run_settings(*options: str) -> RunConfig:
    """Settings of a training run as the command line composes them from options such as ``"method=pop"``.

    Raises `AvatarError` for unknown options, naming the nearest, and values out of range.
    """
    from avatar.config import compose_settings  # hydra, which is not needed to load and pose an avatar

    return compose_settings("train", *options)


def to_mesh(surface: Surface | PointCloud, config: PoissonConfig | None = None) -> Mesh:
    """The mesh of a surface: its own where the method has one, else Poisson reconstruction of its points.

    As it starts a process, a script needs the usual ``if __name__ == "__main__":``. Raises `AvatarError` for points
    that cannot be meshed, and without open3d, naming what to install.
    """
    if isinstance(surface, Surface) and surface.mesh is not None:
        return surface.mesh
    with PoissonMesher(config) as mesher:
        return mesher.mesh(surface.cloud if isinstance(surface, Surface) else surface)


def score(
    prediction: Surface | PointCloud, truth: PointCloud | Scan, metrics: Sequence[str] = METRICS
) -> dict[str, float]:
    """Metrics of one predicted surface against a true one, by name, in their units (`evaluation.metrics.METRICS`).

    Raises `AvatarError` for an unknown metric, one that needs a body, a sequence or a mesh that is not there, or points
    that are not finite.
    """
    cloud, mesh = (prediction.cloud, prediction.mesh) if isinstance(prediction, Surface) else (prediction, None)
    found = find_metrics(tuple(metrics))
    lacking = [m.needs_body or m.sequential or (m.needs_mesh and mesh is None) for m in found]
    if wrong := [metric.name for metric, lacks in zip(found, lacking) if lacks]:
        raise AvatarError(f"metrics: expected those of two surfaces, got {', '.join(wrong)}.")
    comparison = Comparison(cloud, Scan(truth.points, truth.normals), mesh=mesh)
    return {metric.name: float(metric.measure(comparison)) for metric in found}
