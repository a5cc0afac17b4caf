"""Plain folders of scans: meshes or points, one file a scan, and beside them what is known of the bodies."""

from __future__ import annotations

import itertools
import logging
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.body.packed import holds_template
from avatar.body.registry import body_of_file
from avatar.body.solving import posed_vertices, solve_poses
from avatar.checks import AvatarError, DataError, plain_name
from avatar.data.folders import SPLITS
from avatar.invocation import command_line, option
from avatar.io.amass import KEYS, SmplArrays, read_betas, read_smpl_arrays
from avatar.io.documents import read_json_record
from avatar.io.joint_names import INDEX, map_joints
from avatar.io.motions import move_body
from avatar.io.npz import read_arrays
from avatar.io.surfaces import READERS, read_surface
from avatar.records import Mesh, Motion
from avatar.sources.base import PosedScan, Source, SourceConfig, SourceFrame
from avatar.sources.placement import FittedSample, Placement, StandingBody, find_placement

ARRAYS = (".npz", ".json")
PASSED = {  # endings of what belongs to scans and is not read: materials, buffers, textures, notes
    *(".mtl", ".bin", ".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff", ".exr", ".webp", ".dds", ".ktx2"),
    *(".txt", ".md", ".pdf", ".html", ".yaml", ".yml", ".csv", ".log", ".ini", ".db", ".blend"),
}
FIT_FOLDERS = ("body", "bodies", "fit", "fits", "smpl", "smplh", "smplx", "params", "minimal")
BODY_STEMS = ("body", "template")
FIT_WORD = r"(?:body|smplh?|smplx|fit|fitted|minimal|params?|poses?|mesh)"
FIT_ENDING = re.compile(rf"[._-]{FIT_WORD}(?:[._-]{FIT_WORD})*$", re.IGNORECASE)
NUMBERED = re.compile(r"^(.*?)(\d+)$")
VERTEX_KEYS = ("vertices", "verts", "body_verts", "v")
FEWEST_IN_SEQUENCE = 3  # scans in one folder whose names differ in their number alone
SAMPLES = 8  # frames from which units and axes are found
SAMPLE_POINTS = 20_000  # of each scan
SHAPE_SAMPLES = 16  # files that shape coefficients are read from
SHAPES_DIFFER = 0.05  # standard deviations
FOREIGN = 0.01  # metres, root mean square, from a body mesh to the nearest pose of the body
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Fit:
    """Where one frame's body is: a file, and the frame's place in it where it holds all of a folder's."""

    path: Path
    kind: str  # parameters, vertices or mesh
    place: int | None = None
    count: int = 1


@dataclass(frozen=True)
class _Folder:
    """One folder of scans: the split and the sequence that its place says, empty where it says none."""

    path: Path
    split: str
    sequence: str
    scans: tuple[Path, ...]
    others: tuple[Path, ...]


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
        return {plain_name(path.resolve().name, "scans"): path} if any(_folders(path, SourceConfig())) else {}

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        """Frames sorted by split, sequence and number. Raises `DataError` for two scans of one name."""
        found = sorted(self._scans, key=lambda frame: (frame.split, frame.sequence, frame.number))
        unknown = sorted({path.suffix.lower() or path.name for path in self._unknown})
        if unknown:
            log.warning("%s: %d files of unknown kinds are left out: %s.", self.path, len(self._unknown), ", ".join(unknown))
        return tuple(
            replace(frame, files=(*frame.files, *dict.fromkeys(fit.path for fit in self._fits.get(frame.name, ()))))
            for frame in found
        )

    @cached_property
    def body(self) -> BodyModel | None:
        """The body of ``body.path``, or of a file beside the scans; of an SMPL model in the shape of the parameters."""
        given, beside = self.config.body, self._body_file
        if beside is None:
            return None
        settings = {"canonical": given.canonical, "all_joints": given.all_joints, "betas": list(given.betas)}
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
        for fit in self._fits.get(frame.name, ()) if self.body is not None else ():
            if fit.kind == "parameters":
                pose, translation = self._parameters(fit)
                pose, translation = placement.pose(pose, translation, self._pelvis)
                posed = replace(posed, pose=pose, translation=translation)
            else:
                posed = replace(posed, vertices=placement.fit(self._vertices(fit)))
        if posed.vertices is None or posed.pose is not None:
            return posed
        solved = solve_poses(self.body, posed.vertices[None])
        if solved.residuals[0] > FOREIGN:
            problem = f"expected the body in some pose, its mesh is {1000 * solved.residuals[0]:.0f} mm from the nearest."
            raise DataError(frame.files[-1], problem, "Hint: give the shape that was fitted (body.betas), or its body.")
        return replace(posed, pose=solved.poses[0], translation=solved.translations[0])

    def body_mesh(self, frame: SourceFrame) -> Mesh | None:
        """The mesh that was fitted to a scan, of any model, in metres, y up; None where the frame has no such file."""
        fit = next((fit for fit in self._fits.get(frame.name, ()) if fit.kind == "mesh"), None)
        if fit is None:
            return None
        mesh = read_surface(fit.path).mesh
        return replace(mesh, vertices=self._placement.fit(mesh.vertices))

    @cached_property
    def _all_folders(self) -> list[_Folder]:
        folders = list(_folders(self.path, self.config))
        splits = {folder.split for folder in folders}
        if "" in splits and len(splits) > 1:
            stray = next(folder for folder in folders if not folder.split)
            problem = f"expected scans in {', '.join(sorted(splits - {''}))} alone, there are some in {stray.path} too."
            raise DataError(self.path, problem, "Hint: move them.")
        return folders

    @cached_property
    def _scans(self) -> list[SourceFrame]:
        """The frames without the files of their bodies; what is shared by a folder is in its order."""
        frames = [frame for folder in self._all_folders for frame in _folder_frames(folder)]
        names: dict[str, Path] = {}
        for frame in frames:
            other = names.setdefault(frame.name.lower(), frame.files[0])
            if other != frame.files[0]:
                problem = f"expected scans of different names, this one and {other} would both be {frame.name}."
                raise DataError(frame.files[0], problem, "Hint: rename one, or move one out of the folder.")
        return frames

    @cached_property
    def _arrays(self) -> dict[Path, str]:
        """Kinds of the npz and JSON files among all others: parameters, vertices, body; others are left out."""
        found = {}
        for path in dict.fromkeys([*(p for folder in self._all_folders for p in folder.others), *self._fit_files]):
            if path.suffix.lower() in ARRAYS and (kind := _array_kind(path)):
                found[path] = kind
        return found

    @cached_property
    def _fit_files(self) -> list[Path]:
        """Files of ``fits``, or of folders such as smpl/ beside the scans."""
        roots = [self.config.fits] if self.config.fits else [
            path for path in _children(self.path) if path.is_dir() and path.name.lower() in FIT_FOLDERS
        ]  # fmt: skip
        files: list[Path] = []
        for root in roots:
            if not root.exists():
                raise DataError(root, "fits: expected a file or a folder, there is none.")
            files += [root] if root.is_file() else [path for path in sorted(root.rglob("*"), key=_natural) if path.is_file()]
        return [path for path in files if not _hidden(path.name)]

    @cached_property
    def _fits(self) -> dict[str, tuple[_Fit, ...]]:
        """The files that say how each frame's body lies, by the frame's name."""
        found: dict[str, list[_Fit]] = {frame.name: [] for frame in self._scans}
        beside = {folder.path: folder.others for folder in self._all_folders}
        taken: set[Path] = set()
        for frame in self._scans:
            scan = frame.files[0]
            own = [*beside[scan.parent], *self._fits_below(scan)]
            kinds: dict[str, Path] = {}
            for path in own:
                if path == scan or not _belongs(path, scan):
                    continue
                kind = "mesh" if path.suffix.lower() in READERS else self._arrays.get(path)
                if kind in ("parameters", "vertices", "mesh"):
                    if (other := kinds.setdefault(kind, path)) != path:
                        raise DataError(path, f"expected one file of body {kind} for {scan.name}, {other} is another.")
                    taken.add(path)
                    found[frame.name].append(_Fit(path, kind))
        for path, kind in self._arrays.items():
            if kind != "body" and path not in taken:
                frames = self._covered(path)
                for place, frame in enumerate(frames):
                    if any(fit.kind == kind for fit in found[frame.name]):
                        other = next(fit.path for fit in found[frame.name] if fit.kind == kind)
                        raise DataError(path, f"expected one file of body {kind} for {frame.name}, {other} is another.")
                    found[frame.name].append(_Fit(path, kind, place, len(frames)))
        return {name: tuple(fits) for name, fits in found.items()}

    def _fits_below(self, scan: Path) -> list[Path]:
        """Files of the fits' folders that may belong to a scan: those of a folder like its own, where there is one."""
        inner = scan.parent.relative_to(self.path).parts
        return [path for path in self._fit_files if not inner or path.parent.parts[-len(inner) :] == inner] or (
            self._fit_files if len(self._all_folders) == 1 else []
        )

    def _covered(self, path: Path) -> list[SourceFrame]:
        """The frames, in order, that one file of all frames is about: those of its folder, or of the folder so named."""
        folders = [folder for folder in self._all_folders if path in folder.others and folder.scans]
        folders = folders or [folder for folder in self._all_folders if folder.path.name.lower() == path.stem.lower()]
        folders = folders or [folder for folder in self._all_folders if folder.scans]
        if len(folders) != 1:
            problem = f"expected a file for one folder of scans, there are {len(folders)}."
            raise DataError(path, problem, "Hint: put one such file into each folder of scans, or name it as the folder.")
        scans = {scan: place for place, scan in enumerate(folders[0].scans)}
        return sorted((f for f in self._scans if f.files[0] in scans), key=lambda frame: scans[frame.files[0]])

    @cached_property
    def _unknown(self) -> list[Path]:
        """Files that are nothing that is read, passed over or part of the body."""
        known = {fit.path for fits in self._fits.values() for fit in fits} | set(self._arrays) | set(self.body_files)
        others = [path for folder in self._all_folders for path in folder.others]
        return [path for path in others if path not in known and path.suffix.lower() not in PASSED]

    @cached_property
    def _body_file(self) -> Path | None:
        if self.config.body.path is not None:
            return self.config.body.path
        files = [*_children(self.path), *self._fit_files]
        stems = [path for path in files if path.stem.lower() in BODY_STEMS and path.suffix.lower() in (".glb", ".gltf")]
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
        some = [files[place] for place in np.unique(np.linspace(0, len(files) - 1, SHAPE_SAMPLES).astype(int))] if files else []
        shapes = [betas for path in some if (betas := read_betas(path)) is not None]
        if not shapes:
            return []
        if len({betas.shape[1] for betas in shapes}) > 1:
            raise DataError(some[0], "betas: expected as many in every file, got different numbers.")
        every = np.concatenate(shapes)
        if (spread := float(np.ptp(every, axis=0).max(initial=0))) > SHAPES_DIFFER:
            log.warning("%s: shape coefficients differ by %.2g; their mean is taken for all.", self.path, spread)
        return [float(value) for value in every.mean(axis=0)]

    @property
    def _pelvis(self) -> np.ndarray:
        return self.body.zero_joints[0].double().cpu().numpy()

    def _parameters(self, fit: _Fit) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(J, 3)`` of the body's joints and translation ``(3,)`` of a frame, as stored."""
        arrays = self._read_once(fit.path)
        _check_count(fit, len(arrays.poses))
        pose, translation = arrays.poses[fit.place or 0], arrays.translations[fit.place or 0]
        if list(self.body.joint_names[: len(SMPL_JOINTS)]) != SMPL_JOINTS:
            motion = Motion(pose[None], translation[None], 1.0, fit.path.stem)
            pose = move_body(motion, self.body).poses[0]
        return pose, translation

    def _vertices(self, fit: _Fit) -> np.ndarray:
        """Posed vertices ``(V, 3)`` of a frame, as stored, which must be the body's."""
        if fit.kind == "mesh":
            vertices = read_surface(fit.path).vertices
        else:
            arrays = self._read_once(fit.path)
            _check_count(fit, len(arrays))
            vertices = arrays[fit.place or 0]
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
            self._kept[path] = read_smpl_arrays(path, self._pelvis) if parameters else _read_vertices(path)
        return self._kept[path]

    @cached_property
    def _kept(self) -> dict[Path, SmplArrays | np.ndarray]:
        return {}

    @cached_property
    def _placement(self) -> Placement:
        """Units and axes, found from frames spread evenly over the outfit."""
        frames = self._scans
        frames = [frames[place] for place in np.unique(np.linspace(0, len(frames) - 1, SAMPLES).astype(int))]
        scans, fits, known = [], [], None
        for frame in frames:
            points = read_surface(frame.files[0]).vertices
            scans.append(points[np.linspace(0, len(points) - 1, min(len(points), SAMPLE_POINTS)).astype(int)])
            if self.body is not None and self._fits.get(frame.name):
                fits.append((len(scans) - 1, self._sample(self._fits[frame.name][-1])))
        if fits:
            scans = [scans[place] for place, _ in fits]
            known = _standing_body(self.body)
        return find_placement(
            self.path, scans, self.config.units, self.config.up, [fit for _, fit in fits], known
        )

    def _sample(self, fit: _Fit) -> FittedSample:
        """A frame's posed body, with what the file's unit scales apart."""
        if fit.kind != "parameters":
            vertices = self._vertices(fit).astype(np.float64)
            return FittedSample(np.zeros_like(vertices), vertices)
        pose, translation = self._parameters(fit)
        vertices = posed_vertices(self.body, pose).astype(np.float64)
        return FittedSample(vertices, np.broadcast_to(translation.astype(np.float64), vertices.shape))


def _folders(path: Path, config: SourceConfig) -> Iterator[_Folder]:
    """Folders of scans in natural order: the folder itself, its splits, its sequences and their splits' sequences."""

    def visit(folder: Path, split: str, sequence: str, depth: int) -> Iterator[_Folder]:
        children = _children(folder)
        files = [child for child in children if child.is_file()]
        scans = _scan_files(files)
        if scans or depth == 0:
            others = tuple(file for file in files if file not in scans)
            if scans:
                yield _Folder(folder, split, sequence, tuple(scans), others)
            elif others and any(True for _ in itertools.chain.from_iterable(inner for inner in [])):
                yield _Folder(folder, split, sequence, (), others)
        for child in children:
            if not child.is_dir() or child.name.lower() in FIT_FOLDERS or _is_same(child, config.fits):
                continue
            if not split and not sequence and child.name.lower() in SPLITS:
                yield from visit(child, child.name.lower(), "", depth + 1)
            elif not sequence:
                yield from visit(child, split, child.name, depth + 1)

    yield from visit(Path(path), "", "", 0)
