"""The packed layout of POP, ReSynth and CAPE: one npz a frame with body, transforms and scan points."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from avatar.body.model import BodyModel
from avatar.body.packed import packed_body, write_template
from avatar.body.skinning import blend_transforms
from avatar.checks import AvatarError, DataError, check_shape, require
from avatar.data.outfits import OUTFIT_FORMAT, SPLITS, Outfit
from avatar.data.soundness import check_pose
from avatar.geometry.transforms import invert_rigid, transform_points
from avatar.io.atlases import read_obj_atlas
from avatar.io.frames import write_manifest
from avatar.io.meshes import read_mesh
from avatar.io.npz import read_arrays, write_arrays, write_whole
from avatar.io.points import color_bytes, unit_colors
from avatar.records import BodyFit, Frame, Scan, Template

log = logging.getLogger(__name__)

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
    """Packed frames beside a ``template.npz`` or a ``template.obj`` of the body in its T-pose.

    With ``template.npz`` (written by this project or by ``tools/convert_body.py``) what a frame lacks is derived:
    joint transforms from the pose, or from ``vtransf`` by least squares; ``vtransf`` from joint transforms and
    skinning weights; body vertices from either. With ``template.obj`` alone nothing is known of the joints, so
    frames must bring ``body_verts`` and ``vtransf``, and bodies must stand in their root frame already, as those
    packed by POP do.
    """

    @cached_property
    def body(self) -> BodyModel | None:
        """The body of ``template.npz``, or None where there is only a mesh."""
        return packed_body(self.path / "template.npz") if (self.path / "template.npz").is_file() else None

    def _read_template(self) -> Template:
        return self.body.template if self.body else _template_of_mesh(self.path / "template.obj")

    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        stored = read_arrays(path, REQUIRED, OPTIONAL)
        if self.body is None:
            stored = {key: value for key, value in stored.items() if key not in ("joint_transforms", "pose")}
        count, joints = len(self.template.vertices), len(self.template.parents)
        for key, expected in (
            ("body_verts", count),
            ("vtransf", count),
            ("joint_transforms", joints),
        ):
            if key in stored and len(stored[key]) != expected:
                mend = "The frame belongs to another body than the template."
                raise DataError(
                    path, f"{key}: expected {expected} rows as in the template, got {len(stored[key])}.", mend
                )
        if "pose" in stored:
            _check_stored_pose(stored["pose"], joints, path)
        stored = {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in stored.items()}
        normals, colors = stored["scan_n"], stored.get("scan_colors")
        scan = Scan(
            points=stored["scan_pc"],
            normals=normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12),
            faces=self._scan_faces(stored, path),
            labels=stored.get("scan_labels"),
            canonical=stored.get("scan_canonical"),
            colors=None if colors is None else unit_colors(path, colors, colors.dtype.kind in "iu"),
        )
        return Frame(name, self.name, split, self._fit(stored, path), scan)

    @torch.no_grad()
    def fit_pose(self, pose: np.ndarray, translation: np.ndarray | None = None) -> BodyFit:
        """The wearer in any pose; needs the joints and skinning weights of a ``template.npz``."""
        if self.body is None:
            problem = "posing needs skinning weights and joints, and there is only template.obj."
            raise DataError(self.path, problem, "Add a template.npz with tools/convert_body.py.")
        check_pose(pose, len(self.body.parents))
        translation = np.zeros(3, np.float32) if translation is None else np.asarray(translation, np.float32)
        pose = np.asarray(pose, np.float32)
        posed = self.body(torch.from_numpy(pose)[None], torch.from_numpy(translation)[None])
        root = invert_rigid(posed.joint_transforms[0, 0])
        return BodyFit(
            vertices=posed.vertices[0].numpy(),
            vertex_transforms=posed.vertex_transforms[0].numpy(),
            joint_transforms=posed.joint_transforms[0].numpy(),
            pose_vertices=transform_points(root, posed.vertices[0]).numpy(),
            translation=translation,
            pose=pose,
        )

    def _scan_faces(self, stored: dict[str, np.ndarray], path: Path) -> np.ndarray | None:
        """Faces over the scan points, where the frame has them."""
        faces = stored.get("scan_faces")
        if faces is None:
            return None
        if faces.size and (faces.min() < 0 or faces.max() >= len(stored["scan_pc"])):
            raise DataError(path, f"scan_faces: expected indices in [0, {len(stored['scan_pc'])}), got others.")
        return faces.astype(np.int64)

    def _fit(self, stored: dict[str, np.ndarray], path: Path) -> BodyFit:
        """The body of a frame, with what the file lacks derived from what it has."""
        template = self.template
        joint_transforms = self._joint_transforms(stored, path)
        if "vtransf" in stored:
            vertex_transforms = _whole_transforms(stored, template.vertices.numpy(), path)
        else:
            blended = blend_transforms(template.weights, torch.from_numpy(joint_transforms)[None])[0]
            vertex_transforms = _through(blended.numpy(), template.vertices.numpy(), stored.get("body_verts"))
        vertices = stored.get("body_verts")
        if vertices is None:
            vertices = transform_points(torch.from_numpy(vertex_transforms), template.vertices).numpy()
        pose_vertices = stored.get("pose_vertices")
        if pose_vertices is None:
            root = invert_rigid(torch.from_numpy(joint_transforms[0]))
            pose_vertices = transform_points(root, torch.from_numpy(vertices)).numpy()
        return BodyFit(
            vertices=vertices,
            vertex_transforms=vertex_transforms,
            joint_transforms=joint_transforms,
            pose_vertices=pose_vertices,
            translation=stored.get("translation", np.zeros(3, np.float32)),
            pose=stored.get("pose"),
        )

    def _joint_transforms(self, stored: dict[str, np.ndarray], path: Path) -> np.ndarray:
        """Joint transforms ``(J, 4, 4)``: given, from the pose, or by least squares from vertex transforms."""
        if "joint_transforms" in stored:
            return stored["joint_transforms"]
        if self.body is None:
            if "vtransf" not in stored or "body_verts" not in stored:
                mend = "Bring them, or put a template.npz with skinning weights beside the frames."
                raise DataError(path, "expected body_verts and vtransf, as the template has no joints.", mend)
            return np.eye(4, dtype=np.float32)[None]
        if "pose" in stored:
            return self.fit_pose(stored["pose"], stored.get("translation")).joint_transforms
        if "vtransf" not in stored:
            raise DataError(path, "expected vtransf, joint_transforms or pose to place the body, found none of them.")
        whole = _whole_transforms(stored, self.template.vertices.numpy(), path)
        return fit_joint_transforms(whole, self.template.weights.numpy(), self.template.parents)


def fit_joint_transforms(vertex_transforms: np.ndarray, weights: np.ndarray, parents: Sequence[int]) -> np.ndarray:
    """Rigid joint transforms whose blend by the skinning weights is nearest to given vertex transforms.

    Least squares over all vertices, then the nearest rotation to each joint's linear part. A joint that no vertex
    follows moves with its parent.

    Args:
        vertex_transforms: ``(V, 4, 4)``; weights: ``(V, J)``; parents: J indices, parents before children.

    Returns:
        ``(J, 4, 4)`` float32.
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


def _whole_transforms(stored: dict[str, np.ndarray], rest: np.ndarray, path: Path) -> np.ndarray:
    """``vtransf`` as ``(V, 4, 4)`` that carry the template to the posed body.

    Packed files give the rotation block alone, or a translation that leaves out the subject's place in the world;
    where the posed vertices are known, the translation follows from them.
    """
    given = stored["vtransf"]
    if given.shape[-1] == 3 and "body_verts" not in stored:
        raise DataError(path, "expected body_verts, as vtransf has no translations.")
    whole = np.tile(np.eye(4, dtype=np.float32), (len(given), 1, 1))
    whole[:, :3, : given.shape[-1]] = given[:, :3]
    return _through(whole, rest, stored.get("body_verts"))


def _through(transforms: np.ndarray, rest: np.ndarray, posed: np.ndarray | None) -> np.ndarray:
    """The transforms with translations that carry each rest vertex exactly to its posed place, where it is known."""
    if posed is None:
        return transforms
    exact = transforms.copy()
    exact[:, :3, 3] = posed - np.einsum("vij,vj->vi", transforms[:, :3, :3], rest)
    return exact


def _check_stored_pose(pose: np.ndarray, joints: int, path: Path) -> None:
    """Refuses a file's pose that is not axis-angle for the template's joints."""
    try:
        check_pose(pose, joints)
    except AvatarError as error:
        raise DataError(path, str(error)) from error


def _template_of_mesh(path: Path) -> Template:
    """A body that is only a mesh, with its UV atlas if it has one: everything hangs on one root joint at the origin."""
    if not path.is_file():
        problem = "expected template.npz or template.obj (the minimal body in its T-pose), there is neither."
        raise DataError(path.parent, problem, "Make one with tools/convert_body.py.")
    mesh = read_mesh(path)
    faces = np.asarray(mesh.faces, np.int64)
    atlas = read_obj_atlas(path, faces, len(mesh.vertices))
    return Template(
        vertices=torch.from_numpy(np.asarray(mesh.vertices, np.float32)),
        faces=torch.from_numpy(faces),
        weights=torch.ones(len(mesh.vertices), 1),
        joints=torch.zeros(1, 3),
        parents=(-1,),
        joint_names=("root",),
        uv=None if atlas is None else torch.from_numpy(atlas.uv),
        uv_faces=None if atlas is None else torch.from_numpy(atlas.uv_faces),
    )


def write_packed_frame(path: Path, frame: Frame) -> None:
    """Writes a frame as a packed npz that this project and the readers of the POP line understand."""
    body, scan = frame.body, frame.scan
    arrays = {
        "body_verts": body.vertices,
        "vtransf": body.vertex_transforms,
        "joint_transforms": body.joint_transforms,
        "pose": body.pose,
        "translation": body.translation,
        "pose_vertices": body.pose_vertices,
        "scan_pc": scan.points,
        "scan_n": scan.normals,
        "scan_faces": scan.faces,
        "scan_labels": scan.labels,
        "scan_canonical": scan.canonical,
        "scan_colors": None if scan.colors is None else color_bytes(scan.colors),
        "scan_name": np.array(frame.name),
    }
    write_arrays(path, {key: value for key, value in arrays.items() if value is not None})


def write_packed_outfit(outfit: Outfit, folder: Path) -> PackedOutfit:
    """Writes all frames of an outfit, of whatever layout, as a packed outfit with template and manifest.

    Raises:
        DataError: for a frame that is not sound.
    """
    folder = Path(folder)
    write_template(folder / "template.npz", outfit.template)
    settings = {"format": OUTFIT_FORMAT, "layout": "packed", "source": f"{outfit.dataset}/{outfit.name}"}
    write_whole(folder / "outfit.yaml", require("yaml").safe_dump(settings, sort_keys=False).encode())
    for split in SPLITS:
        names = outfit.frames(split) if (outfit.path / split).is_dir() else ()
        for name in names:
            write_packed_frame(folder / split / f"{name}.npz", outfit.load(split, name))
        log.info("%s: %d %s frames packed.", folder, len(names), split)
    write_manifest(folder)
    return PackedOutfit(folder)
