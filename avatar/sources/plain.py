"""Plain folders of scans: meshes or points, one file a scan, and beside them what is known of the bodies."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.body.packed import holds_template
from avatar.body.registry import body_of_file
from avatar.body.solving import PoseSolver, posed_vertices
from avatar.checks import DataError, plain_name
from avatar.invocation import command_line, option
from avatar.io.amass import SmplArrays, poses_hands, read_betas, read_smpl_arrays
from avatar.io.joint_names import INDEX, map_joints
from avatar.io.motions import move_body
from avatar.io.npz import read_arrays
from avatar.io.rigs import RIG_SUFFIXES
from avatar.io.surfaces import READERS, read_surface
from avatar.records import Mesh, Motion
from avatar.sources.base import PosedScan, Source, SourceFrame
from avatar.sources.listing import (
    ARRAYS,
    BODY_STEMS,
    PASSED,
    VERTEX_KEYS,
    ScanFolder,
    array_kind,
    is_fit_folder,
    list_folders,
    list_frames,
    own_stem,
    visible,
)
from avatar.sources.placement import FittedSample, Placement, StandingBody, find_placement

SAMPLES = 8  # frames from which units and axes are found
SAMPLE_POINTS = 20_000  # of each scan
SHOWN = 5  # names of files that are left out
SHAPE_SAMPLES = 16  # files that shape coefficients are read from
SHAPES_DIFFER = 0.05  # standard deviations
FOREIGN = 0.01  # metres, root mean square, from a body mesh to the nearest pose of the body
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Fit:
    """Where one frame's body is: a file, and the frame's place in it where it holds all of a folder's."""

    path: Path
    kind: str  # parameters, vertices or mesh
    place: int = 0
    count: int = 1  # frames that the file must have


class PlainScans(Source):
    """Scans of one outfit in a folder, in sub-folders of sequences, or in train, test and interpolation folders.

    A scan is a mesh or oriented points in any format of `read_surface`. Frames are in natural order of their names. The
    bodies are beside them, or where ``fits`` says: body parameters under any key of `read_smpl_arrays`, one file a scan
    with its stem or one a folder; meshes of the body itself, one a scan (``<stem>_body.obj``, or its stem in a folder
    such as ``smpl/``); posed vertices ``(T, V, 3)`` or ``(V, 3)`` of an npz; or nothing. The body is ``body.path``, or
    ``template.npz`` or ``body.npz`` or ``.glb`` beside them.
    """

    layout = "plain"

    @classmethod
    def find(cls, path: Path) -> dict[str, Path]:
        """The folder itself as one outfit where it or its sub-folders hold scans; empty elsewhere."""
        path = Path(path)
        holds = any(folder.scans for folder in list_folders(path))
        return {plain_name(path.resolve().name, "scans"): path} if holds else {}

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        """Frames sorted by split, sequence and number. Raises `DataError` for two scans of one name."""
        if unknown := [path.name for path in self._unknown]:
            names = ", ".join(unknown[:SHOWN]) + ", ..." * (len(unknown) > SHOWN)
            log.warning(
                "%s: %d files that nothing is known of, or damaged, are left out: %s.", self.path, len(unknown), names
            )
        return tuple(
            replace(frame, files=(*frame.files, *dict.fromkeys(fit.path for fit in self._fits[frame.name])))
            for frame in self._scans
        )

    @cached_property
    def body(self) -> BodyModel | None:
        """The body of ``body.path``, or of a file beside the scans; of an SMPL model in the shape of the parameters."""
        given, beside = self.config.body, self._body_file
        if beside is None:
            return None
        whole = given.all_joints
        if whole is None:  # parameters are read for 22 joints, meshes show the hands as well
            whole = not any(fit.kind == "parameters" for fits in self._fits.values() for fit in fits)
        settings = {"canonical": given.canonical, "all_joints": whole, "betas": list(given.betas)}
        if not given.betas and beside.suffix.lower() == ".npz" and not holds_template(beside):
            settings["betas"] = self._betas
        return body_of_file(beside, settings, "body.")

    @property
    def body_files(self) -> tuple[Path, ...]:
        """The body's file, if any."""
        return () if self._body_file is None else (self._body_file,)

    @property
    def decisions(self) -> dict[str, str]:
        """Units and axes that were found."""
        return self._placement.decided

    def read(self, frame: SourceFrame) -> PosedScan:
        """A frame in metres, y up. Raises `DataError` for body meshes that are not the body's own in any pose."""
        surface, placement = read_surface(frame.files[0]), self._placement
        normals = None if surface.normals is None else placement.normals(surface.normals)
        posed = PosedScan(replace(surface, vertices=placement.scan(surface.vertices), normals=normals))
        for fit in self._fits[frame.name] if self.body is not None else ():
            if fit.kind == "parameters":
                pose, translation = self._parameters(fit)
                pose, translation = placement.pose(pose, translation, self._pelvis)
                posed = replace(posed, pose=pose, translation=translation)
            else:
                posed = replace(posed, vertices=placement.fit(self._vertices(fit)))
        if posed.vertices is None or posed.pose is not None:
            return posed
        solved = self._solver.solve(posed.vertices[None])
        if solved.residuals[0] > FOREIGN:
            apart = 1000 * solved.residuals[0]
            problem = f"expected the body in some pose, got a mesh {apart:.0f} mm from the nearest."
            raise DataError(frame.files[-1], problem, "Hint: give the shape that was fitted (body.betas), or its body.")
        return replace(posed, pose=solved.poses[0], translation=solved.translations[0])

    def body_mesh(self, frame: SourceFrame) -> Mesh | None:
        """The mesh that was fitted to a scan, of any model, in metres, y up; None where the frame has no such file."""
        fit = next((fit for fit in self._fits[frame.name] if fit.kind == "mesh"), None)
        if fit is None:
            return None
        mesh = read_surface(fit.path).mesh
        return replace(mesh, vertices=self._placement.fit(mesh.vertices))

    @cached_property
    def _folders(self) -> list[ScanFolder]:
        return list_folders(self.path, self.config.fits)

    @cached_property
    def _scans(self) -> list[SourceFrame]:
        """The frames without the files of their bodies."""
        return list_frames(self._folders)

    @cached_property
    def _fit_files(self) -> dict[Path, None]:
        """Files of ``fits``, or of folders such as smpl/ beside the scans."""
        roots = [self.config.fits]
        if self.config.fits is None:
            roots = [path for path in visible(self.path) if path.is_dir() and is_fit_folder(path)]
        elif not self.config.fits.exists():
            raise DataError(self.config.fits, "fits: expected a file or a folder, there is none.")
        files: list[Path] = []
        while roots:
            root = roots.pop(0)
            files += [root] if root.is_file() else []
            roots += visible(root) if root.is_dir() else []
        return dict.fromkeys(files)

    @cached_property
    def _arrays(self) -> dict[Path, str]:
        """Kinds of the npz, JSON and pickled files: parameters, vertices, body; others are left out."""
        others = [path for folder in self._folders for path in folder.others]
        found = [path for path in dict.fromkeys([*others, *self._fit_files]) if path.suffix.lower() in ARRAYS]
        return {path: kind for path in found if (kind := array_kind(path))}

    @cached_property
    def _fits(self) -> dict[str, tuple[Fit, ...]]:
        """What says how each frame's body lies, by the frame's name: at most one file of each kind."""
        found: dict[str, dict[str, Fit]] = {frame.name: {} for frame in self._scans}

        def add(frame: SourceFrame, fit: Fit) -> None:
            other = found[frame.name].setdefault(fit.kind, fit)
            if other.path != fit.path:
                problem = f"expected one file of body {fit.kind} for {frame.files[0]}, {other.path} is another."
                raise DataError(fit.path, problem, "Hint: give fits=.")

        owned: set[Path] = set()
        for frame in self._scans:
            for path in self._candidates(frame.files[0]):
                kind = "mesh" if path.suffix.lower() in READERS else self._arrays.get(path, "body")
                if kind != "body":
                    owned.add(path)
                    add(frame, Fit(path, kind))
        for path, kind in self._arrays.items():
            if kind != "body" and path not in owned:
                frames = self._covered(path)
                for place, frame in enumerate(frames):
                    add(frame, Fit(path, kind, place, len(frames)))
        return {name: tuple(fits.values()) for name, fits in found.items()}

    def _candidates(self, scan: Path) -> list[Path]:
        """Files of a scan's name: beside it, unless ``fits`` are given, and of the fits' folder like its own.

        Folders of fits are ordered as those of scans are, or all in one.
        """
        found = [path for key in {scan.stem.lower(), own_stem(scan)} for path in self._named.get(key, ())]
        inner = scan.parent.relative_to(self.path).parts
        beside = [path for path in found if path.parent == scan.parent and self.config.fits is None]
        apart = [path for path in found if path in self._fit_files]
        alike = [path for path in apart if inner and path.parent.parts[-len(inner) :] == inner]
        alone = sum(bool(folder.scans) for folder in self._folders) == 1
        return beside + (alike or (apart if alone else []))

    @cached_property
    def _named(self) -> dict[str, list[Path]]:
        """Files that may be about single scans by the names that these may have."""
        found: dict[str, list[Path]] = {}
        others = [path for folder in self._folders for path in folder.others]
        for path in dict.fromkeys([*others, *self._fit_files]):
            for key in dict.fromkeys((path.stem.lower(), own_stem(path))):
                found.setdefault(key, []).append(path)
        return found

    def _covered(self, path: Path) -> list[SourceFrame]:
        """The frames, in order, that one file of many is about: those of its folder, or of the folder of its name."""
        scanned = [folder for folder in self._folders if folder.scans]
        folders = [folder for folder in scanned if path in folder.others]
        folders = folders or [folder for folder in scanned if folder.path.name.lower() == path.stem.lower()] or scanned
        if len(folders) != 1:
            problem = f"expected a file about one folder of scans, there are {len(folders)}."
            raise DataError(path, problem, "Hint: put such a file into each folder of scans, or name it as the folder.")
        of = {frame.files[0]: frame for frame in self._scans}
        return [of[scan] for scan in folders[0].scans]

    @cached_property
    def _unknown(self) -> list[Path]:
        """Files that are nothing that is read, passed over or part of the body."""
        known = {fit.path for fits in self._fits.values() for fit in fits} | set(self._arrays) | set(self.body_files)
        others = [path for folder in self._folders for path in folder.others]
        return [path for path in others if path not in known and path.suffix.lower() not in PASSED]

    @cached_property
    def _body_file(self) -> Path | None:
        if self.config.body.path is not None:
            return self.config.body.path
        files = [*(path for folder in self._folders for path in folder.others), *self._fit_files]
        stems = [path for path in files if path.stem.lower() in BODY_STEMS and path.suffix.lower() in RIG_SUFFIXES]
        found = list(dict.fromkeys([*(path for path, kind in self._arrays.items() if kind == "body"), *stems]))
        if len(found) > 1:
            raise DataError(found[1], f"expected one body, {found[0]} is another.", "Hint: give body.path=.")
        if not found and any(self._fits.values()):
            line = command_line("data_fit", option("source", self.path))
            hint = "give body.path=, a converted SMPL model, a template.npz or a rigged GLB; or fit the open body"
            log.warning("%s: bodies are known, their model is not: %s: %s", self.path, hint, line)
        return found[0] if found else None

    @cached_property
    def _betas(self) -> list[float]:
        """Shape coefficients of the parameters, the mean over the frames; empty where they have none."""
        files = list(dict.fromkeys(f.path for fits in self._fits.values() for f in fits if f.kind == "parameters"))
        some = _some(files, SHAPE_SAMPLES)
        shapes = [betas for path in some if (betas := read_betas(path)) is not None]
        if not shapes:
            return []
        if len({betas.shape[1] for betas in shapes}) > 1:
            raise DataError(some[0], "betas: expected as many in every file, got different numbers.")
        every = np.concatenate(shapes)
        if (spread := float(np.ptp(every, axis=0).max(initial=0))) > SHAPES_DIFFER:
            log.warning("%s: shape coefficients differ by %.2g; their mean is taken for all.", self.path, spread)
        return [float(value) for value in every.mean(axis=0)]

    @cached_property
    def _solver(self) -> PoseSolver:
        return PoseSolver(self.body)

    @property
    def _pelvis(self) -> np.ndarray:
        return self.body.zero_joints[0].double().cpu().numpy()

    def _parameters(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(J, 3)`` of the body's joints and translation ``(3,)`` of a frame, as stored."""
        arrays = self._read_once(fit.path)
        _check_count(fit, len(arrays.poses))
        pose, translation = arrays.poses[fit.place], arrays.translations[fit.place]
        if list(self.body.joint_names[: len(SMPL_JOINTS)]) != SMPL_JOINTS:
            motion = Motion(pose[None, : len(SMPL_JOINTS)], translation[None], 1.0, fit.path.stem)
            pose = move_body(motion, self.body).poses[0]
        return pose, translation

    def _vertices(self, fit: Fit) -> np.ndarray:
        """Posed vertices ``(V, 3)`` of a frame, as stored, which must be the body's."""
        if fit.kind == "mesh":
            vertices = read_surface(fit.path).vertices
        else:
            arrays = self._read_once(fit.path)
            _check_count(fit, len(arrays))
            vertices = arrays[fit.place]
        if len(vertices) != (expected := len(self.body.bind_vertices)):
            problem = f"expected the {expected} vertices of the body, got {len(vertices)}."
            line = command_line("data_fit", option("source", self.path))
            raise DataError(fit.path, problem, f"Hint: give its own model as body.path=; or fit the open body: {line}")
        return vertices

    def _read_once(self, path: Path) -> SmplArrays | np.ndarray:
        """The parameters or vertices of a file; that of all frames stays in memory."""
        if path not in self._kept:
            if len(self._kept) > 1:
                self._kept.clear()
            parameters = self._arrays[path] == "parameters"
            joints = len(self.body.parents)
            if parameters and not self._hands and poses_hands(path):
                self._hands.append(path)
                log.warning("%s: hands and face of body parameters are laid at rest.", path)
            self._kept[path] = read_smpl_arrays(path, self._pelvis, joints) if parameters else _read_vertices(path)
        return self._kept[path]

    @cached_property
    def _kept(self) -> dict[Path, SmplArrays | np.ndarray]:
        return {}

    @cached_property
    def _hands(self) -> list[Path]:
        """The first file whose hands were left out, once that was said."""
        return []

    @cached_property
    def _placement(self) -> Placement:
        """Units and axes, found from frames spread evenly over the outfit."""
        scans, fits, known = [], [], None
        for frame in _some(self._scans, SAMPLES):
            scans.append(_some(read_surface(frame.files[0]).vertices, SAMPLE_POINTS))
            if self.body is not None and self._fits[frame.name]:
                fits.append((len(scans) - 1, self._sample(self._fits[frame.name][-1])))
        if fits:
            scans = [scans[place] for place, _ in fits]
            known = _standing_body(self.body)
        return find_placement(self.path, scans, self.config.units, self.config.up, [fit for _, fit in fits], known)

    def _sample(self, fit: Fit) -> FittedSample:
        """A frame's posed body, with what the file's unit scales apart."""
        if fit.kind != "parameters":
            vertices = self._vertices(fit).astype(np.float64)
            return FittedSample(np.zeros_like(vertices), vertices)
        pose, translation = self._parameters(fit)
        vertices = posed_vertices(self.body, pose).astype(np.float64)
        return FittedSample(vertices, np.broadcast_to(translation.astype(np.float64), vertices.shape))


def _some(items: Any, most: int) -> Any:
    """At most so many of a list or an array's rows, evenly."""
    places = np.unique(np.linspace(0, len(items) - 1, min(len(items), most)).astype(int))
    return items[places] if isinstance(items, np.ndarray) else [items[place] for place in places]


def _check_count(fit: Fit, count: int) -> None:
    """Refuses a file of another number of frames than its folder has scans."""
    if count != fit.count:
        problem = f"expected {fit.count} frames, one a scan, got {count}."
        raise DataError(fit.path, problem, "Hint: leave the others out.")


def _read_vertices(path: Path) -> np.ndarray:
    """Posed vertices ``(T, V, 3)`` of an npz."""
    found = read_arrays(path, {}, {key: f"number T{key} V{key} 3 | V{key} 3" for key in VERTEX_KEYS})
    vertices = next(found[key] for key in VERTEX_KEYS if key in found)
    return vertices if vertices.ndim == 3 else vertices[None]


def _standing_body(body: BodyModel) -> StandingBody:
    """A body's faces, and the shares of its ankles and its shoulders, by the joints' weights."""
    joints, weights = map_joints(body.joint_names, body.parents), body.weights.double().cpu().numpy()

    def share(*names: str) -> np.ndarray:
        of = weights[:, [joints[INDEX[name]] for name in names if INDEX[name] in joints]].sum(axis=1)
        return of / of.sum()

    low = share("left_ankle", "right_ankle", "left_knee", "right_knee")
    return StandingBody(body.faces.cpu().numpy(), low, share("left_shoulder", "right_shoulder"))
