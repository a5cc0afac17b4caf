"""Textures of meshes on disk: UV coordinates as npz beside a PNG, and textured OBJ and GLB files."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError, DataError, check_faces, check_file, check_finite, check_shape, check_suffix
from avatar.io.meshes import check_mesh
from avatar.io.npz import naming, read_arrays, write_arrays, write_whole
from avatar.records import Mesh

FORMAT = "texture/1"
FILES = ("texture.npz", "texture.png")
TEXTURED = (".obj", ".glb")
KEYS = {"faces": "int F 3", "uv": "float U 2", "uv_faces": "int F 3", "sha256": "text "}
PNG_BYTES = 256 << 20
PNG_START = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
HINT = "Make the texture again: python tools/texture.py."
FLOAT, WHOLE, VERTICES, INDICES = 5126, 5125, 34962, 34963  # glTF's names of kinds and of buffers' uses


@dataclass(frozen=True)
class Texture:
    """A texture of a mesh: ``faces (F, 3)`` of the mesh, ``uv (U, 2)`` in [0, 1], v upwards, ``uv_faces (F, 3)`` the
    index of each corner's, and the image as the bytes of a PNG file.
    """

    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray
    png: bytes

    def fits(self, mesh: Mesh) -> bool:
        """Whether it is a texture of this mesh: the faces are the same."""
        return np.array_equal(self.faces, mesh.faces)


def write_texture(folder: str | Path, texture: Texture) -> None:
    """Writes ``texture.png`` and ``texture.npz``, float32 and int32, into a folder.

    Raises `AvatarError` as `check_texture` does.
    """
    check_texture(texture)
    arrays = {"faces": np.asarray(texture.faces, np.int32), "uv": np.asarray(texture.uv, np.float32)}
    arrays |= {"uv_faces": np.asarray(texture.uv_faces, np.int32), "sha256": np.array(_digest(texture.png))}
    write_whole(Path(folder) / FILES[1], texture.png)
    write_arrays(Path(folder) / FILES[0], {"format": np.array(FORMAT)} | arrays)


def read_texture(folder: str | Path) -> Texture:
    """Reads the texture of a folder, checked; indices come as int64, the image is not decoded.

    Raises `DataError` that names the file and what is wrong with it, also for an image that is not the one that was
    written with these coordinates.
    """
    path, image = (Path(folder) / name for name in FILES)
    stored = read_arrays(path, KEYS, version=FORMAT)
    check_file(image, PNG_BYTES)
    png = image.read_bytes()
    if _digest(png) != str(stored["sha256"]):
        raise DataError(image, "expected the image that was written with texture.npz, got another one.", HINT)
    texture = Texture(stored["faces"].astype(np.int64), stored["uv"], stored["uv_faces"].astype(np.int64), png)
    with naming(path, HINT):
        check_texture(texture)
    return texture


def check_texture(texture: Texture) -> None:
    """Refuses a texture that is not one.

    Raises:
        AvatarError: for shapes that do not fit, coordinates out of [0, 1], indices out of range, or no PNG.
    """
    count = check_shape("uv", texture.uv, "U 2")["U"]
    dims = check_shape("faces", texture.faces, "F 3")
    check_shape("uv_faces", texture.uv_faces, "F 3", **dims)
    check_finite("uv", texture.uv)
    check_faces(texture.faces, int(np.max(texture.faces, initial=0)) + 1)
    try:
        check_faces(texture.uv_faces, count)
    except AvatarError as error:
        raise AvatarError(f"uv_{error}") from error
    if texture.uv.min() < 0 or texture.uv.max() > 1:
        raise AvatarError(f"uv: expected coordinates in [0, 1], got {texture.uv.min():.3g} to {texture.uv.max():.3g}.")
    if not texture.png.startswith(PNG_START):
        raise AvatarError("png: expected the bytes of a PNG file, got others.")


def write_textured_mesh(path: str | Path, mesh: Mesh, texture: Texture) -> list[Path]:
    """Writes a mesh with its texture as OBJ or GLB by its ending; gives the files.

    An OBJ names ``texture.mtl`` beside it, which names ``texture.png``; both are written, the same for all meshes of a
    folder. A GLB holds the image. Float32 metres, y up; the mesh's own colours are left out. Equal meshes give equal
    bytes. Raises `AvatarError` for an invalid mesh or a texture of another one, `DataError` for another ending.
    """
    path = Path(path)
    suffix = check_suffix(path, TEXTURED, "a textured mesh file")
    check_mesh(mesh)
    check_texture(texture)
    if not texture.fits(mesh):
        raise AvatarError(f"texture: expected one of the mesh's {len(mesh.faces)} faces, it is another mesh's. {HINT}")
    if suffix == ".glb":
        write_whole(path, textured_glb(mesh, texture))
        return [path]
    lines = ["mtllib texture.mtl", "usemtl texture"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in texture.uv.tolist()]
    corners = np.stack([mesh.faces, texture.uv_faces], axis=2).reshape(-1, 6) + 1
    lines += [f"f {a}/{p} {b}/{q} {c}/{r}" for a, p, b, q, c, r in corners.tolist()]
    material, image = path.with_name("texture.mtl"), path.with_name(FILES[1])
    write_whole(image, texture.png)
    write_whole(material, b"newmtl texture\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nmap_Kd texture.png\n")
    write_whole(path, ("\n".join(lines) + "\n").encode("ascii"))
    return [path, material, image]


def textured_glb(mesh: Mesh, texture: Texture) -> bytes:
    """The bytes of a binary glTF 2.0 file of a mesh with its texture: a vertex for each pair of place and coordinates.

    Normals are the mesh's smooth ones, also across the atlas's seams.
    """
    pairs = np.stack([mesh.faces, texture.uv_faces], axis=2).reshape(-1, 2)
    pairs, corners = np.unique(pairs, axis=0, return_inverse=True)
    vertices = np.asarray(mesh.vertices, np.float32)
    points, uv = vertices[pairs[:, 0]], np.asarray(texture.uv, np.float32)[pairs[:, 1]]
    arrays = [points, smooth_normals(vertices, mesh.faces)[pairs[:, 0]], np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)]
    parts = [*(array.astype("<f4").tobytes() for array in arrays), corners.astype("<u4").tobytes(), texture.png]
    parts = [part + b"\0" * (-len(part) % 4) for part in parts]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    views = [{"buffer": 0, "byteOffset": start, "byteLength": len(part)} for start, part in zip(starts, parts)]
    for number, use in enumerate((VERTICES, VERTICES, VERTICES, INDICES)):
        views[number]["target"] = use
    accessors = [
        {"bufferView": number, "componentType": FLOAT, "count": len(array), "type": f"VEC{array.shape[1]}"}
        for number, array in enumerate(arrays)
    ]
    accessors[0] |= {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    accessors.append({"bufferView": 3, "componentType": WHOLE, "count": corners.size, "type": "SCALAR"})
    shading = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 0.9}
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    document = {
        "asset": {"version": "2.0", "generator": "avatar"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"name": "texture", "pbrMetallicRoughness": shading, "doubleSided": True}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    header = json.dumps(document, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    body = b"".join(parts)
    chunks = struct.pack("<I4s", len(header), b"JSON") + header + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals ``(V, 3)`` float32 of vertices; along y where undefined, for glTF wants unit ones."""
    corners = vertices[faces].astype(np.float64)
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = [np.bincount(faces.reshape(-1), column.repeat(3), len(vertices)) for column in crosses.T]
    normals = np.stack(sums, axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-20, normals / np.maximum(length, 1e-20), (0.0, 1.0, 0.0))
    return normals.astype(np.float32)


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
