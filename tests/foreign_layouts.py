"""Data sets in the layouts that other programs leave, made of one person: the keys, types, units and folders of each.

What the real files have beside what is read (position maps, cameras, textures, pickled objects) is there too, so that
reading it would show. `Truth` is what a frame must be after conversion.
"""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from smpl_person import BETAS, CLOTH, frame_arrays, pose_person, whole_pose
from tiny import tiny_pose

from avatar.body.smpl import convert_body_model, joint_tree
from avatar.geometry.surface import vertex_normals
from avatar.io.meshes import write_mesh
from avatar.records import Mesh

OBJECTS = np.array([{"never": "read"}, None], dtype=object)
Model = dict[str, np.ndarray]


@dataclass(frozen=True)
class Truth:
    """A frame: ``scan (M, 3)`` and ``body (V, 3)`` metres, the pose of 22 joints and the translation."""

    scan: np.ndarray
    body: np.ndarray
    pose: np.ndarray
    translation: np.ndarray


def smplx_person(person: Model) -> Model:
    """The person as SMPL-X has it: 55 joints, of which hands and face move nothing; expressions behind shapes."""
    parents, count = joint_tree("smplx")[1], 22
    owners = [*range(count), *parents[count:]]
    for joint in range(count, 55):
        while owners[joint] >= count:
            owners[joint] = owners[owners[joint]]
    vertices = len(person["v_template"])
    weights = np.concatenate([person["weights"][:, :count], np.zeros((vertices, 33))], axis=1)
    for hand, wrist in ((22, 20), (23, 21)):
        weights[:, wrist] += person["weights"][:, hand]
    posedirs = np.zeros((vertices, 3, 9 * 54))
    posedirs[..., : 9 * 21] = person["posedirs"][..., : 9 * 21]
    rng = np.random.default_rng(0)
    hands = {f"hands_mean{side}": 0.2 * rng.normal(size=45) for side in "lr"}
    hands |= {f"hands_components{side}": 0.2 * rng.normal(size=(45, 45)) for side in "lr"}
    return (
        person
        | hands
        | {
            "weights": weights,
            "J_regressor": person["J_regressor"][owners],
            "posedirs": posedirs,
            "shapedirs": np.concatenate([person["shapedirs"], np.zeros_like(person["shapedirs"])], axis=-1),
            "kintree_table": np.array([[2**32 - 1, *parents[1:]], range(55)], np.int64).astype(np.uint32),
        }
    )


def write_bodies(folder: Path, person: Model) -> dict[str, Path]:
    """The person's converted model files by their kinds."""
    found = {}
    for kind, model in (("smpl", person), ("smplx", smplx_person(person))):
        found[kind] = folder / f"{kind}.npz"
        np.savez(folder / f"{kind.upper()}_FEMALE.npz", **model)
        assert convert_body_model(folder / f"{kind.upper()}_FEMALE.npz", found[kind]) == kind
    return found


def truth_of(person: Model, share: float, rooted: bool = False) -> Truth:
    """The person in a pose, under a mesh of cloth; ``rooted`` leaves the root where it is at rest."""
    pose = tiny_pose(share).astype(np.float64)
    translation = np.zeros(3) if rooted else np.array([0.3, 0.1, 0.2 + share])
    pose[0] = [0, 0 if rooted else 0.4, 0]
    pose, translation = pose.astype(np.float32).astype(np.float64), translation.astype(np.float32).astype(np.float64)
    body = pose_person(person, whole_pose(pose), translation).vertices
    normals = vertex_normals(torch.from_numpy(body), torch.from_numpy(person["f"].astype(np.int64))).numpy()
    return Truth(body + CLOTH * normals, body, pose, translation)


def shaped(person: Model) -> np.ndarray:
    """The person's minimal body in the T-pose ``(V, 3)``."""
    return person["v_template"] + person["shapedirs"][..., : len(BETAS)] @ BETAS


def mesh_of(person: Model, vertices: np.ndarray) -> Mesh:
    """A mesh of the person's triangles."""
    return Mesh(vertices, person["f"].astype(np.int64))


def write_pickle(path: Path, stored: dict) -> None:
    """A pickled dictionary, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(stored, protocol=4))


def save(path: Path, **arrays: np.ndarray) -> None:
    """An npz file, with its folder; arrays of objects are pickled, as numpy does unasked."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)


SHARES = {"train": (0.0, 1.0), "test": (0.5,)}
TAKES = {"walk": (0.0, 1.0), "soccer": (0.5,)}  # sequences of layouts without splits


def write_packed(root: Path, person: Model) -> dict[str, Truth]:
    """POP's ReSynth with SkiRT's second tree: one outfit, in its root frame."""
    outfit, found = "rp_ada_posed_001", {}
    for split, shares in SHARES.items():
        for number, share in enumerate(shares):
            truth, name = truth_of(person, share, rooted=True), f"rp_{outfit}.96_hips.{number:05d}"
            posed = pose_person(person, whole_pose(truth.pose), np.zeros(3))
            arrays = frame_arrays(person, share, turn=0)
            points = arrays["scan_pc"] - arrays["translation"]
            body = {"body_verts": truth.body.astype(np.float32), "vtransf": posed.transforms[:, :3, :3]}
            maps = {f"posmap{side}": np.zeros((side, side, 3), np.float32) for side in (32, 128)}
            maps |= {"posmap_canonical32": maps["posmap32"]}
            scan = {"scan_pc": points, "scan_n": arrays["scan_n"], "scan_name": name, "meta": OBJECTS}
            save(root / "packed" / outfit / split / f"{name}.npz", **body, **maps, **scan)
            mean = pose_person(person | {"shapedirs": 0 * person["shapedirs"]}, whole_pose(truth.pose), np.zeros(3))
            save(
                root / "extra" / outfit / split / f"{name}.npz",
                body_pose=truth.pose.reshape(-1),
                subj_body_v=truth.body,
                mean_body_v=mean.vertices,
                subj_body_v_cano_bs=shaped(person),
                jT_pa=np.tile(np.eye(4), (22, 1, 1)),
            )
            found[f"{split}/{name}"] = Truth(points, truth.body, truth.pose, truth.translation)
    (root / "minimal_body_shape").mkdir()
    write_mesh(root / "minimal_body_shape" / f"{outfit}.obj", mesh_of(person, shaped(person)))
    return found


def write_cape(root: Path, person: Model) -> dict[str, Truth]:
    """CAPE's raw release: two sets of clothes of one subject, of which one has raw scans in millimetres."""
    found = {}
    for clothes in ("shortlong", "blazerlong"):
        for motion, shares in TAKES.items():
            sequence = f"{clothes}_{motion}_trial1"
            for number, share in enumerate(shares, start=1):
                truth, name = truth_of(person, share), f"{sequence}.{number:06d}"
                pose = {"pose": whole_pose(truth.pose).reshape(-1), "transl": truth.translation}
                clothed = {"v_posed": truth.scan, "v_cano": shaped(person), "info": OBJECTS}
                save(root / "sequences" / "00096" / sequence / f"{name}.npz", **pose, **clothed)
                if clothes == "blazerlong":
                    raw = root / "raw_scans" / "00096" / sequence / f"{name}.ply"
                    write_mesh(raw, mesh_of(person, 1000 * truth.scan))
                found[f"00096_{clothes}/{name}"] = truth
    folder = root / "minimal_body_shape" / "00096"
    folder.mkdir(parents=True)
    np.save(folder / "00096_minimal.npy", shaped(person))
    return found


def write_scanimate(root: Path, person: Model) -> dict[str, Truth]:
    """SCANimate's folder: scans in millimetres, parameters as npz in one sequence and as pickles in the other."""
    write_mesh(root / "minimal.ply", mesh_of(person, shaped(person)))
    found = {}
    for sequence, shares in TAKES.items():
        for number, share in enumerate(shares):
            truth, path = truth_of(person, share), root / sequence / f"{sequence}.{number:06d}.ply"
            path.parent.mkdir(exist_ok=True)
            write_mesh(path, mesh_of(person, 1000 * truth.scan))
            pose = whole_pose(truth.pose).reshape(-1)
            if sequence == "walk":
                save(path.with_suffix(".npz"), pose=pose, transl=truth.translation)
            else:
                write_pickle(
                    path.with_suffix(".pkl"), {"pose": pose, "trans": truth.translation, "betas": np.zeros(10)}
                )
            found[path.stem] = truth
    (root / "walk_textured").mkdir()
    write_mesh(root / "walk_textured" / "walk.000000.ply", mesh_of(person, truth.scan))
    return found


def write_fite(root: Path, person: Model) -> dict[str, Truth]:
    """FITE's folders: a subject with scan meshes and points."""
    subject, found = "ada", {}
    for split, shares in SHARES.items():
        for number, share in enumerate(shares):
            truth, name = truth_of(person, share), f"hips.{number:05d}"
            points = frame_arrays(person, share)
            save(
                root / "data_scans" / subject / split / f"{name}.npz",
                pose=whole_pose(truth.pose).reshape(-1).astype(np.float32),
                transl=truth.translation.astype(np.float32),
                scan_v=truth.scan,
                scan_f=person["f"].astype(np.int64),
                scan_pc=points["scan_pc"],
                scan_n=points["scan_n"],
            )
            found[f"{split}/{name}"] = truth
    folder = root / "data_templates" / subject
    folder.mkdir(parents=True)
    write_mesh(folder / f"{subject}_minimal_tpose.ply", mesh_of(person, shaped(person)))
    (folder.parent / "gender_list.yaml").write_text(f"{subject}: female\n")
    return found


def smplx_arguments(truth: Truth) -> dict[str, np.ndarray]:
    """smplx's arguments of a pose, as its users store them: with an axis of one frame, hands and face at rest."""
    still = {"jaw_pose": 3, "leye_pose": 3, "reye_pose": 3, "left_hand_pose": 45, "right_hand_pose": 45}
    found = {key: np.zeros((1, count), np.float32) for key, count in still.items()}
    found |= {"global_orient": truth.pose[:1], "body_pose": truth.pose[1:].reshape(1, -1)}
    found |= {"transl": truth.translation[None], "betas": np.array([*BETAS, *[0.0] * 7])[None]}
    return {key: value.astype(np.float32) for key, value in found.items()} | {"expression": np.zeros((1, 10))}


def write_dress4d(root: Path, person: Model) -> dict[str, Truth]:
    """4D-DRESS: one subject's outer outfit in two takes, all of it pickled."""
    found, count = {}, len(person["v_template"])
    for take, shares in (("Take2", TAKES["walk"]), ("Take11", TAKES["soccer"])):
        folder = root / "00122" / "Outer" / take
        frames = [f"{11 + number:05d}" for number in range(len(shares))]
        info = {"scan_frames": frames, "rotation": np.eye(3), "offset": np.zeros(3), "gender": "female"}
        write_pickle(folder / "basic_info.pkl", info)
        for frame, share in zip(frames, shares):
            truth = truth_of(person, share)
            scan = {"vertices": truth.scan, "faces": person["f"].astype(np.int32), "uvs": np.zeros((count, 2))}
            normals = vertex_normals(torch.from_numpy(truth.scan), torch.from_numpy(scan["faces"].astype(np.int64)))
            scan |= {"normals": normals.numpy(), "colors": np.full((count, 4), 200, np.uint8), "uv_path": "atlas.pkl"}
            write_pickle(folder / "Meshes_pkl" / f"mesh-f{frame}.pkl", scan)
            write_pickle(folder / "Meshes_pkl" / f"atlas-f{frame}.pkl", {"not": "read"})
            write_pickle(folder / "SMPLX" / f"mesh-f{frame}_smplx.pkl", smplx_arguments(truth))
            write_mesh(folder / "SMPLX" / f"mesh-f{frame}_smplx.ply", mesh_of(person, truth.body))
            labels = {"scan_labels": np.arange(count) % 6}
            write_pickle(folder / "Semantic" / "labels" / f"label-f{frame}.pkl", labels)
            found[f"{take}.{int(frame):05d}"] = truth
    return found


def write_thuman(root: Path, person: Model) -> dict[str, Truth]:
    """Single scans of any size, with the scale that was fitted: parameters as pickle, npz and JSON."""
    found, scale = {}, 0.8
    for number, share in enumerate(SHARES["train"] + SHARES["test"]):
        truth, folder = truth_of(person, share), root / f"{number:04d}"
        folder.mkdir(parents=True)
        beyond = np.array([0.1, 0.2, 0.3])
        name = "scan.obj" if number % 2 else f"{folder.name}.ply"
        write_mesh(folder / name, mesh_of(person, scale * truth.scan + beyond))
        stored = smplx_arguments(truth) | {"scale": np.float32([scale]), "translation": beyond}
        if number % 3 == 0:
            write_pickle(folder / "smplx_param.pkl", stored | {"scale": np.float32(scale)})
        elif number % 3 == 1:
            save(folder / "smplx_param.npz", **stored)
        else:
            listed = {key: np.asarray(value).tolist() for key, value in stored.items()}
            (folder / "smplx_param.json").write_text(json.dumps(listed))
        shift = beyond / np.float32(scale)
        found[folder.name] = Truth(truth.scan + shift, truth.body + shift, truth.pose, truth.translation + shift)
    return found


WRITERS = {
    "packed": (write_packed, "smplx"),
    "cape_raw": (write_cape, "smpl"),
    "scanimate": (write_scanimate, "smpl"),
    "fite": (write_fite, "smpl"),
    "dress4d": (write_dress4d, "smplx"),
    "thuman": (write_thuman, "smplx"),
}
