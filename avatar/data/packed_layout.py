"""The packed layout of POP, ReSynth and CAPE: one npz a frame with body, transforms and scan points."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.body.packed import write_body, write_template
from avatar.body.registry import body_of_file, canonical_name
from avatar.body.skinning import blend_transforms, skin_transforms
from avatar.checks import DataError, check_shape, require
from avatar.data.alignment import thin
from avatar.data.folders import OUTFIT_FORMAT, SPLITS, read_outfit_settings
from avatar.data.outfits import Outfit
from avatar.data.validation import check_pose, check_posed, check_size, check_vertex_transforms
from avatar.geometry.transforms import invert_rigid, transform_points
from avatar.io.frames import write_manifest
from avatar.io.ledger import digest_of, file_digest
from avatar.io.meshes import read_mesh, read_obj_atlas
from avatar.io.npz import naming, read_arrays, write_arrays, write_whole
from avatar.io.points import color_bytes, unit_colors
from avatar.records import BodyFit, Frame, Scan, Template

log = logging.getLogger(__name__)

ROUNDING = (5e-4, 2e-3)  # metres: doubtful, and refused
BODY, MEAN = "body", "mean_body"  # keys of outfit.yaml
BODY_FILES = {BODY: "template.npz", MEAN: "mean.npz"}  # where a body is that outfit.yaml gives no path

# What a file and what a record calls the same
BODY_KEYS = {"body_verts": "vertices", "vtransf": "vertex_transforms"}
BODY_KEYS |= {key: key for key in ("joint_transforms", "pose", "translation", "pose_vertices")}
SCAN_KEYS = {"scan_pc": "points", "scan_n": "normals"}
SCAN_KEYS |= {f"scan_{key}": key for key in ("faces", "labels", "canonical", "colors")}
REQUIRED = {"scan_pc": "float M 3", "scan_n": "float M 3"}
OPTIONAL = {
    "body_verts": "float V 3",
    "vtransf": "float V 3 3 | V 4 4",
    "joint_transforms": "float J 4 4",
    "pose": "float ...",  # `check_pose` says what another shape is
    "translation": "float 3",
    "pose_vertices": "float V 3",
    "scan_faces": "int F 3",
    "scan_labels": "uint8 M",
    "scan_canonical": "float M 3",
    "scan_colors": "number M 3",  # uint8, or floats in [0, 1]
}


class PackedOutfit(Outfit):
    """Packed frames beside a body of the person who was scanned (docs/data.md has every key).

    The body is what ``outfit.yaml`` names, or ``template.npz``. What a frame lacks is derived: joint transforms from
    the pose, or from ``vtransf`` by least squares; ``vtransf`` from either; body vertices from any of them. What it has
    must agree. With ``template.obj`` alone nothing is known of the joints: frames must bring ``body_verts`` and
    ``vtransf``, in their root frame, as those packed by POP do.
    """

    @cached_property
    def body(self) -> BodyModel | None:
        return self._body_of(BODY)

    @cached_property
    def mean_body(self) -> BodyModel | None:
        mean, own = self._body_of(MEAN), self.body
        if mean is None or own is None:
            return own
        if not torch.equal(mean.faces, own.faces) or mean.joint_names != own.joint_names:
            raise DataError(self.path, "mean_body: expected the faces and joints of body, got others.")
        return mean

    @cached_property
    def shared_digest(self) -> str:
        """One hash over the files that the outfit's frames share, bodies elsewhere included."""
        files = [file for file, _ in self._bodies.values()]
        return digest_of([super().shared_digest, *(file_digest(file) for file in files if file.is_file())])

    @cached_property
    def _bodies(self) -> dict[str, tuple[Path, dict[str, Any]]]:
        """File and settings of the outfit's bodies by their keys, without those that nothing speaks of."""
        found = {}
        for key, default in BODY_FILES.items():
            said = read_outfit_settings(self.path).get(key)
            if said is not None and not (isinstance(said, dict) and isinstance(said.get("path", ""), str)):
                problem = f"{key}: expected a mapping such as {{path: {default}, betas: []}}, got {said}."
                raise DataError(self.path / "outfit.yaml", problem)
            if said is not None or (self.path / default).is_file():
                settings = dict(said or {})
                found[key] = self.path / settings.pop("path", default), settings
        return found

    def _body_of(self, key: str) -> BodyModel | None:
        if key not in self._bodies:
            return None
        with naming(self.path / "outfit.yaml"):
            return body_of_file(*self._bodies[key], f"{key}.")

    def _read_template(self) -> Template:
        return self.body.template if self.body else template_of_mesh(self.path / "template.obj")

    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        return self.frame_of(read_arrays(path, REQUIRED, OPTIONAL), path, split, name)

    def frame_of(self, stored: dict[str, np.ndarray], path: Path, split: str, name: str) -> Frame:
        """A frame of a file's arrays, whose keys and shapes are those of `REQUIRED` and `OPTIONAL`.

        Raises `DataError` naming ``path`` for arrays that do not fit the body or each other.
        """
        if self.body is None:
            stored = {key: value for key, value in stored.items() if key not in ("joint_transforms", "pose")}
        rows = dict.fromkeys(("body_verts", "vtransf"), len(self.template.vertices))
        for key, expected in (rows | {"joint_transforms": len(self.template.parents)}).items():
            if key in stored and len(stored[key]) != expected:
                problem = f"{key}: expected {expected} rows as in the template, got {len(stored[key])}."
                raise DataError(path, problem, "The frame belongs to another body than the template.")
        self._check_rounding(stored, path)
        if "pose" in stored:
            stored["pose"] = _stored_pose(stored["pose"], self.template.joint_names, path)
        stored = {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in stored.items()}
        return Frame(name, self.name, split, self._fit(stored, path), _stored_scan(stored, path))

    def _check_rounding(self, stored: dict[str, np.ndarray], path: Path) -> None:
        """Refuses positions so far from the origin that their type, or float32, rounds them much; some is doubtful."""
        for key in ("scan_pc", "body_verts"):
            if key not in stored or not stored[key].size:
                continue
            middle = float(np.abs(np.median(stored[key][thin(len(stored[key]), 1000)], axis=0)).max())
            kind = np.float16 if stored[key].dtype.itemsize == 2 else np.float32
            step = float(np.spacing(kind(middle)))
            if step > ROUNDING[0]:
                near = f"{key}: expected positions near the origin"
                problem = f"{near}, {kind.__name__} rounds those at {middle:.4g} m to {step:.2g} m."
                hint = "Move body, scan and translation to the origin; store float32."
                if not step <= ROUNDING[1]:
                    raise DataError(path, problem, hint)
                self._doubt(f"{key} rounding", path, f"{problem} {hint}")

    def _fit(self, stored: dict[str, np.ndarray], path: Path) -> BodyFit:
        """The body of a frame, with what the file lacks derived from what it has, and the rest of it compared."""
        template, vertices, posed = self.template, stored.get("body_verts"), None
        if "pose" in stored:
            posed = self.fit_pose(stored["pose"], stored.get("translation"))
            if vertices is not None and "translation" not in stored:
                posed = self.fit_pose(stored["pose"], (vertices - posed.vertices).mean(axis=0, dtype=np.float64))
        whole = _whole_transforms(stored, path) if "vtransf" in stored else None
        joint_transforms = self._joint_transforms(stored, posed, whole, path)
        joints, given = torch.from_numpy(joint_transforms), "joint_transforms" in stored
        if given or (whole is None and posed is None):
            skinned = skin_transforms(template.weights, joints[None], template.canonical_from_bind)[0].numpy()
        transforms = whole if whole is not None else skinned if posed is None else posed.vertex_transforms
        if vertices is None:
            vertices = _move(transforms, template)
        if doubt := check_size(vertices, template, path):
            self._doubt("size", path, doubt)
        if posed is not None:
            others = self._mistaken_poses(stored["pose"], vertices)
            check_posed(posed.vertices, vertices, "pose", template, path, others)
        if given:
            check_posed(_move(skinned, template), vertices, "joint_transforms", template, path)
        if whole is not None:
            check_vertex_transforms(whole, template, vertices, path)
        pose_vertices = stored.get("pose_vertices")
        if pose_vertices is None and posed is not None and self.mean_body is not self.body:
            pose_vertices = posed.pose_vertices
        elif pose_vertices is None:
            pose_vertices = transform_points(invert_rigid(joints[0]), torch.from_numpy(vertices)).numpy()
        return BodyFit(
            vertices=vertices,
            vertex_transforms=_fit_translations(transforms, template, vertices),
            joint_transforms=joint_transforms,
            pose_vertices=pose_vertices,
            translation=stored.get("translation", np.zeros(3, np.float32) if posed is None else posed.translation),
            pose=stored.get("pose"),
        )

    def _mistaken_poses(self, pose: np.ndarray, vertices: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
        """The body, as far along as ``vertices (V, 3)``, in poses that a frame's may have been mistaken for."""
        names = list(self.template.joint_names)
        sides = [name.replace("left", "*").replace("right", "left").replace("*", "right") for name in names]
        poses = {"If negated": -pose, "If its root is at rest": np.concatenate([0 * pose[:1], pose[1:]])}
        if set(sides) == set(names):
            poses["If left and right are exchanged"] = pose[[names.index(name) for name in sides]]

        def place(pose: np.ndarray) -> np.ndarray:
            posed = self.fit_pose(pose).vertices
            return posed + (vertices - posed).mean(axis=0)

        return {words: partial(place, pose) for words, pose in poses.items()}

    def _joint_transforms(
        self, stored: dict[str, np.ndarray], posed: BodyFit | None, whole: np.ndarray | None, path: Path
    ) -> np.ndarray:
        """Joint transforms ``(J, 4, 4)``: given, from the pose, or by least squares from vertex transforms.

        Skinning weights blend motions from the bind pose, so those are what is solved for.
        """
        if "joint_transforms" in stored:
            return stored["joint_transforms"]
        if self.body is None:
            if "vtransf" not in stored or "body_verts" not in stored:
                hint = "Bring them, or put a template.npz with skinning weights beside the frames."
                raise DataError(path, "expected body_verts and vtransf, as the template has no joints.", hint)
            return np.eye(4, dtype=np.float32)[None]
        if posed is not None:
            return posed.joint_transforms
        if whole is None:
            raise DataError(path, "expected vtransf, joint_transforms or pose to place the body, found none of them.")
        template, bound = self.template, self.template.canonical_from_bind
        exact = torch.from_numpy(_fit_translations(whole, template, stored.get("body_verts")))
        from_bind = (exact @ blend_transforms(template.weights, bound[None])[0]).numpy()
        solved = fit_joint_transforms(from_bind, template.weights.numpy(), template.parents)
        return solved @ invert_rigid(bound).numpy()


def _stored_scan(stored: dict[str, np.ndarray], path: Path) -> Scan:
    scan = Scan(**{name: stored.get(key) for key, name in SCAN_KEYS.items()})
    normals = scan.normals / np.maximum(np.linalg.norm(scan.normals, axis=1, keepdims=True), 1e-12)
    faces, colors = scan.faces, scan.colors
    if faces is not None and faces.size and (faces.min() < 0 or faces.max() >= len(scan.points)):
        raise DataError(path, f"scan_faces: expected indices in [0, {len(scan.points)}), got others.")
    faces = faces.astype(np.int64) if faces is not None and len(faces) else None
    colors = None if colors is None else unit_colors(path, colors, colors.dtype.kind in "iu")
    return replace(scan, normals=normals, faces=faces, colors=colors)


def _move(transforms: np.ndarray, template: Template) -> np.ndarray:
    """The template's vertices ``(V, 3)``, each moved by its transform ``(V, 4, 4)``."""
    return transform_points(torch.from_numpy(transforms), template.vertices).numpy()


def fit_joint_transforms(vertex_transforms: np.ndarray, weights: np.ndarray, parents: Sequence[int]) -> np.ndarray:
    """Rigid joint transforms ``(J, 4, 4)`` float32 whose blend by ``weights (V, J)`` is nearest to ``(V, 4, 4)``.

    Least squares, then the nearest rotation; a joint that no vertex follows moves with its parent.
    """
    dims = check_shape("vertex_transforms", vertex_transforms, "V 4 4")
    check_shape("weights", weights, "V J", **dims)
    flat = vertex_transforms[:, :3].reshape(len(weights), 12).astype(np.float64)
    solved = np.linalg.lstsq(weights.astype(np.float64), flat, rcond=None)[0].reshape(-1, 3, 4)
    joints = np.tile(np.eye(4), (len(parents), 1, 1))
    for joint, parent in enumerate(parents):
        if weights[:, joint].max() < 1e-3:
            joints[joint] = joints[parent] if parent >= 0 else joints[joint]
            continue
        left, _, right = np.linalg.svd(solved[joint, :, :3])
        left[:, -1] *= np.sign(np.linalg.det(left @ right))
        joints[joint, :3, :3] = left @ right
        joints[joint, :3, 3] = solved[joint, :, 3]
    return joints.astype(np.float32)


def _whole_transforms(stored: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """``vtransf`` as ``(V, 4, 4)``; files may lack translations, or leave out the subject's place in the world."""
    given = stored["vtransf"]
    if given.shape[-1] == 3 and "body_verts" not in stored:
        raise DataError(path, "expected body_verts, as vtransf has no translations.")
    whole = np.tile(np.eye(4, dtype=np.float32), (len(given), 1, 1))
    whole[:, :3, : given.shape[-1]] = given[:, :3]
    return whole


def _fit_translations(transforms: np.ndarray, template: Template, posed: np.ndarray | None) -> np.ndarray:
    """The transforms with translations that pose each of the template's vertices exactly, where that is known."""
    if posed is None:
        return transforms
    exact = transforms.copy()
    exact[:, :3, 3] = posed - np.einsum("vij,vj->vi", transforms[:, :3, :3], template.vertices.numpy())
    return exact


def _stored_pose(pose: np.ndarray, joint_names: Sequence[str], path: Path) -> np.ndarray:
    """A file's pose as axis-angle of the body's joints ``(J, 3)``; of hands and face either may lack some, at rest.

    Raises `DataError` for another shape, or rotations of joints that the body lacks.
    """
    rows, joints, shared = len(pose) if pose.shape[1:] == (3,) else 0, len(joint_names), len(SMPL_JOINTS)
    if list(joint_names[:shared]) == SMPL_JOINTS and shared <= rows != joints:
        if np.any(pose[joints:]):
            problem = f"pose: expected rotations of {joints} joints, it turns joints beyond them."
            raise DataError(path, problem, "Set body.all_joints: true in outfit.yaml to keep hands and face.")
        pose = np.concatenate([pose[:joints], np.zeros((max(joints - rows, 0), 3), pose.dtype)])
    with naming(path):
        check_pose(pose, joints)
    return pose


def template_of_mesh(path: Path) -> Template:
    """A body that is only a mesh, with an OBJ's UV atlas if it has one: everything hangs on one root at the origin."""
    if not path.is_file():
        problem = "expected template.npz or template.obj (the minimal body in its T-pose), there is neither."
        target = shlex.quote(str(path.with_suffix(".npz")))
        hint = f"Make one: python tools/convert_body.py <downloaded SMPL file> {target}"
        raise DataError(path.parent, problem, hint)
    mesh = read_mesh(path)
    atlas = read_obj_atlas(path, mesh.faces, len(mesh.vertices)) if path.suffix == ".obj" else None
    return Template(
        vertices=torch.from_numpy(mesh.vertices),
        faces=torch.from_numpy(mesh.faces),
        weights=torch.ones(len(mesh.vertices), 1),
        joints=torch.zeros(1, 3),
        parents=(-1,),
        joint_names=("root",),
        **({} if atlas is None else {key: torch.from_numpy(value) for key, value in vars(atlas).items()}),
    )


def write_packed_frame(path: Path, frame: Frame) -> None:
    """Writes a frame as a packed npz that this project and the readers of the POP line understand."""
    arrays = {key: getattr(frame.body, name) for key, name in BODY_KEYS.items()}
    arrays |= {key: getattr(frame.scan, name) for key, name in SCAN_KEYS.items()}
    if frame.scan.colors is not None:
        arrays["scan_colors"] = color_bytes(frame.scan.colors)
    arrays["scan_name"] = np.array(frame.name)
    write_arrays(path, {key: value for key, value in arrays.items() if value is not None})


def write_packed_outfit(outfit: Outfit, folder: Path) -> PackedOutfit:
    """Writes all frames of an outfit as a packed outfit with template and manifest; `DataError` for an invalid one."""
    folder = Path(folder)
    settings = {"format": OUTFIT_FORMAT, "layout": "packed", "source": f"{outfit.dataset}/{outfit.name}"}
    if outfit.body is None:
        write_template(folder / BODY_FILES[BODY], outfit.template)
    else:
        bodies = {BODY: outfit.body} | ({} if outfit.mean_body is outfit.body else {MEAN: outfit.mean_body})
        for key, body in bodies.items():
            write_body(folder / BODY_FILES[key], body)
            settings[key] = {"canonical": canonical_name(body)}
    write_whole(folder / "outfit.yaml", require("yaml").safe_dump(settings, sort_keys=False).encode())
    for split in SPLITS:
        names = outfit.frames(split) if outfit.has_frames(split) else ()
        for name in names:
            write_packed_frame(folder / split / f"{name}.npz", outfit.load(split, name))
        log.info("%s: %d %s frames packed.", folder, len(names), split)
    write_manifest(folder)
    return PackedOutfit(folder)
