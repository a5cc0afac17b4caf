"""glTF 2.0 scenes (.glb, .gltf): nodes, primitives and skins as one mesh; buffers only from the file's own folder."""

from __future__ import annotations

import base64
import binascii
import json
import shlex
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from avatar.checks import DataError, check_file
from avatar.io.raw_surface import RawSurface, fan_triangles, strip_triangles

MAX_BYTES = 2 << 30
MAX_NODES = 100_000
MAX_DEPTH = 1000  # of nodes below each other
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
POINTS, TRIANGLES, STRIP, FAN = 0, 4, 5, 6
DRACO, QUANTIZED = "KHR_draco_mesh_compression", "KHR_mesh_quantization"
COMPRESSED = (DRACO, "EXT_meshopt_compression", "KHR_meshopt_compression", QUANTIZED)
HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_lights_")
UNDO = {DRACO: "copy"}  # commands of gltf-transform, which all undo compression in reading


@dataclass
class Scene:
    """A parsed file: its JSON, its buffers, and the elements that were read from it."""

    path: Path
    json: dict[str, Any]
    buffers: dict[int, bytes]
    read: int = 0  # numbers of vertices and corners so far
    limit: int = 0  # of them
    notes: list[str] = field(default_factory=list)

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """An entry of a list of the JSON; `DataError` where there is none."""
        entries = self.json.get(kind)
        if not (isinstance(entries, list) and type(index) is int and 0 <= index < len(entries)):
            raise DataError(self.path, f"expected {kind}[{index!r:.50}], got none.")
        if not isinstance(entries[index], dict):
            raise DataError(
                self.path, f"expected {kind}[{index}] to be an object, got {type(entries[index]).__name__}."
            )
        return entries[index]

    def note(self, text: str) -> None:
        """Adds a note, once."""
        if text not in self.notes:
            self.notes.append(text)

    def count(self, number: int) -> None:
        """Counts vertices or corners; `DataError` where instances make more of them than the file has bytes."""
        self.read += number
        if self.read > self.limit:
            problem = f"expected less, its scene promises {self.read} elements, more than its {self.limit} bytes."
            raise DataError(self.path, problem, "Hint: export the mesh once.")


@dataclass
class Part:
    """A primitive in the scene's frame."""

    vertices: np.ndarray
    normals: np.ndarray | None
    colors: np.ndarray | None
    faces: list[np.ndarray] = field(default_factory=list)  # of each primitive; empty for points


def read_gltf(path: Path, data: bytes) -> RawSurface:
    """The scene of a GLB or glTF file as one mesh, unchecked, or as points where it has no triangles.

    Node transforms are applied; skinned meshes are read in the pose that their joints are stored in. Primitives of a
    mesh that share their vertices share them still. Raises `DataError` naming the file and what is wrong: compressed or
    quantised geometry with the command that undoes it, URIs out of the file's folder, accessors beyond their buffers.
    """
    with reading_gltf(path):
        return _read(open_scene(path, data))


@contextmanager
def reading_gltf(path: Path) -> Iterator[None]:
    """Errors that come of invalid JSON within the block become `DataError`."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(path, f"cannot be read as glTF 2.0 ({error!r:.200}).", "Hint: export it again.") from error


def open_scene(path: Path, data: bytes) -> Scene:
    """The JSON and the binary chunk of a file; `DataError` for other versions, and extensions that cannot be read."""
    document, binary = _chunks(path, data)
    _check_version(path, document)
    return Scene(path, document, {} if binary is None else {-1: binary}, limit=len(data))


def _read(scene: Scene) -> RawSurface:
    parts: list[Part] = []
    skinned = False
    for node, transform, of in scene_nodes(scene):
        skin = node.get("skin")
        skinned |= skin is not None
        parts += _mesh_parts(scene, node["mesh"], transform, None if skin is None else skin_joints(scene, skin, of))
    if skinned:
        scene.note("A skinned mesh is read in the pose its joints are stored in; animations are not applied.")
    if any(part.faces for part in parts):
        lone = sum(len(part.vertices) for part in parts if not part.faces)
        if lone:
            scene.note(f"{lone} points beside its triangles are left out.")
        parts = [part for part in parts if part.faces]
    if not parts:
        raise DataError(
            scene.path, "expected triangles or points in its scene, got none.", "Hint: export the mesh itself."
        )
    return _join(scene, parts)


def _chunks(path: Path, data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """JSON and, of a GLB, the binary chunk."""
    binary = None
    if data[:4] == b"glTF":
        version, _, length, kind = struct.unpack_from("<III4s", data, 4) if len(data) >= 20 else (0, 0, 0, b"")
        if version != 2 or kind != b"JSON" or length > len(data) - 20:
            problem = f"expected a whole GLB of version 2, got version {version}: cannot be read."
            raise DataError(path, problem, "Hint: export it as glTF 2.0.")
        text, place = data[20 : 20 + length], 20 + length
        if len(data) - place >= 8:
            length, kind = struct.unpack_from("<I4s", data, place)
            binary = data[place + 8 : place + 8 + length] if kind == b"BIN\0" else None
    elif path.suffix.lower() == ".glb":
        raise DataError(path, "expected a GLB file, got something else: cannot be read.", "Hint: export it again.")
    else:
        text = data.removeprefix(b"\xef\xbb\xbf")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"cannot be read as glTF: its JSON is damaged ({error!s:.200}).") from error
    if not isinstance(document, dict):
        raise DataError(path, "expected a glTF document, got other JSON.")
    return document, binary


def _check_version(path: Path, document: dict[str, Any]) -> None:
    """Refuses other versions and extensions without which the geometry cannot be read."""
    version = str(document.get("asset", {}).get("version", "none"))
    if not version.startswith("2."):
        raise DataError(path, f"expected glTF 2.0, got version {version:.20}.", "Hint: export it as glTF 2.0.")
    for name in document.get("extensionsRequired", []):
        if name in COMPRESSED:
            raise _compressed(path, name)
        if not str(name).startswith(HARMLESS):
            problem = f"expected plain geometry, got a file that requires the extension {name!s:.100}."
            raise DataError(path, problem, "Hint: export it without.")


def _compressed(path: Path, name: str) -> DataError:
    problem = f"expected plain float32 positions, got geometry with {name}."
    command = f"gltf-transform {UNDO.get(name, 'dequantize')} {shlex.quote(path.name)} plain.glb"
    hint = f"Hint: undo it with {command} (npm install --global @gltf-transform/cli)."
    return DataError(path, problem, hint)


def scene_nodes(scene: Scene) -> Iterator[tuple[dict[str, Any], np.ndarray, dict[int, np.ndarray]]]:
    """Nodes with a mesh, with world transforms ``(4, 4)`` of theirs and, by number, of all nodes."""
    nodes = scene.json.get("nodes", [])
    scenes = scene.json.get("scenes", [])
    if len(nodes) > MAX_NODES:
        raise DataError(scene.path, f"expected at most {MAX_NODES} nodes, got {len(nodes)}.")
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [index for index in range(len(nodes)) if index not in children]
    shown = roots
    if scenes:
        shown = scene.item("scenes", scene.json.get("scene", 0)).get("nodes", [])
        if len(scenes) > 1:
            scene.note(f"One of {len(scenes)} scenes is read, the default one.")
    world: dict[int, np.ndarray] = {}
    stack = [(root, np.eye(4), 0) for root in roots]  # joints may hang outside the scene that is shown
    while stack:
        index, parent, depth = stack.pop()
        if index in world or depth > MAX_DEPTH:
            raise DataError(scene.path, f"expected a tree of nodes, got node {index} twice or too deep.")
        node = scene.item("nodes", index)
        world[index] = parent @ _local(scene, node)
        stack += [(child, world[index], depth + 1) for child in node.get("children", [])]
    stack, seen = list(reversed(shown)), set()
    while stack:
        index = stack.pop()
        if index in seen or index not in world:
            raise DataError(scene.path, f"expected a tree of nodes, got node {index!r:.50} in a circle or twice.")
        seen.add(index)
        if "EXT_mesh_gpu_instancing" in nodes[index].get("extensions", {}):
            raise DataError(scene.path, "expected plain nodes, got instances by EXT_mesh_gpu_instancing.")
        if "mesh" in nodes[index]:
            yield nodes[index], world[index], world
        stack += reversed(nodes[index].get("children", []))


def _local(scene: Scene, node: dict[str, Any]) -> np.ndarray:
    """A node's transform ``(4, 4)`` to its parent's frame, from its matrix or translation, rotation and scale."""
    if "matrix" in node:
        local = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        local = np.eye(4)
        local[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
        local[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    if not np.isfinite(local).all():
        raise DataError(scene.path, "expected finite transforms of nodes, got NaN or infinite ones.")
    return local


def skin_joints(scene: Scene, skin: int, world: dict[int, np.ndarray]) -> np.ndarray:
    """Transforms ``(J, 4, 4)`` of a skin's joints from the mesh's own frame to the scene's."""
    entry = scene.item("skins", skin)
    joints = np.stack([world[joint] for joint in entry["joints"]])
    if "inverseBindMatrices" not in entry:
        return joints
    inverse = read_accessor(scene, entry["inverseBindMatrices"], "MAT4").reshape(-1, 4, 4)
    if len(inverse) < len(joints):
        raise DataError(scene.path, f"expected inverse bind matrices of {len(joints)} joints, got {len(inverse)}.")
    return joints @ np.swapaxes(inverse[: len(joints)], 1, 2)


def _mesh_parts(scene: Scene, mesh: int, transform: np.ndarray, joints: np.ndarray | None) -> list[Part]:
    """Parts of a mesh, one for each set of vertices that its primitives use."""
    entry = scene.item("meshes", mesh)
    parts: dict[tuple, Part] = {}
    for primitive in entry["primitives"]:
        attributes, mode = primitive["attributes"], primitive.get("mode", TRIANGLES)
        if mode not in (POINTS, TRIANGLES, STRIP, FAN):
            scene.note("Lines are left out.")
            continue
        extensions = primitive.get("extensions", {})
        if primitive.get("targets"):
            scene.note("Morph targets are not applied.")
        key = tuple(sorted(attributes.items()))
        if key not in parts:
            position = scene.item("accessors", attributes["POSITION"])
            if DRACO in extensions and "bufferView" not in position:
                raise _compressed(scene.path, DRACO)
            if position["componentType"] != 5126:
                raise _compressed(scene.path, QUANTIZED)
            parts[key] = _vertices(scene, attributes, transform, joints)
            colored = "COLOR_0" in attributes
            if not colored and "material" in primitive and _has_texture(scene, primitive["material"]):
                scene.note("Textures are not read: no colours.")
        part = parts[key]
        faces = primitive_faces(scene, primitive, mode, len(part.vertices))
        if faces is not None and joints is None and np.linalg.det(transform[:3, :3]) < 0:
            faces = faces[:, ::-1]  # a mirrored node turns the winding round (glTF 2.0, 3.7.4)
        if faces is not None:
            part.faces.append(faces)
    return list(parts.values())


def _vertices(scene: Scene, attributes: dict[str, int], transform: np.ndarray, joints: np.ndarray | None) -> Part:
    """A set of vertices in the scene's frame."""
    positions = read_accessor(scene, attributes["POSITION"], "VEC3")
    normals = read_accessor(scene, attributes["NORMAL"], "VEC3") if "NORMAL" in attributes else None
    colors = None
    if "COLOR_0" in attributes:
        entry = scene.item("accessors", attributes["COLOR_0"])
        colors = read_accessor(scene, attributes["COLOR_0"], "VEC3" if entry["type"] == "VEC3" else "VEC4")[:, :3]
        colors = np.clip(colors, 0, 1) if np.isfinite(colors).all() else None
    if any(of is not None and len(of) != len(positions) for of in (normals, colors)):
        raise DataError(scene.path, f"expected {len(positions)} normals and colours, got another number.")
    if joints is None:
        turned = positions @ transform[:3, :3].T + transform[:3, 3]
        x, y, z = transform[:3, :3]
        cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)])  # the inverse's transpose, scaled
        sign = np.sign(x @ cofactors[0])
        normals = None if normals is None else normals @ cofactors.T * sign
    else:
        blended = _blend(scene, attributes, joints, len(positions))
        turned = np.einsum("vij,vj->vi", blended[:, :3, :3], positions) + blended[:, :3, 3]
        normals = None if normals is None else np.einsum("vij,vj->vi", blended[:, :3, :3], normals)
    return Part(turned, normals, colors)


def _blend(scene: Scene, attributes: dict[str, int], joints: np.ndarray, count: int) -> np.ndarray:
    """Blended transforms ``(V, 4, 4)`` of a skinned mesh's vertices."""
    ids, weights = read_influences(scene, attributes, len(joints), count)
    return np.einsum("vk,vkc->vc", weights, joints.reshape(-1, 16)[ids]).reshape(-1, 4, 4)


def read_influences(scene: Scene, attributes: dict[str, int], joints: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Joint indices and skinning weights ``(V, K)`` of a skinned mesh's ``count`` vertices, rows summing to 1."""
    ids, weights = [np.empty((count, 0), np.int64)], [np.empty((count, 0))]
    while f"JOINTS_{len(ids) - 1}" in attributes:
        number = len(ids) - 1
        ids.append(read_accessor(scene, attributes[f"JOINTS_{number}"], "VEC4", normalize=False).astype(np.int64))
        weights.append(read_accessor(scene, attributes[f"WEIGHTS_{number}"], "VEC4"))
        if len(ids[-1]) != count or len(weights[-1]) != count or (ids[-1].size and ids[-1].max() >= joints):
            raise DataError(scene.path, f"expected joints below {joints} for {count} vertices, got others.")
    chosen, values = np.concatenate(ids, axis=1), np.concatenate(weights, axis=1)
    totals = values.sum(axis=1, keepdims=True)
    if not count or not (totals > 0).all():
        raise DataError(scene.path, "expected skinning weights for all vertices, got none for some.")
    return chosen, values / totals


def primitive_faces(scene: Scene, primitive: dict[str, Any], mode: int, count: int) -> np.ndarray | None:
    """Triangles ``(F, 3)`` of a primitive; None for points."""
    if mode == POINTS:
        return None
    if "indices" in primitive:
        entry = scene.item("accessors", primitive["indices"])
        if entry["componentType"] not in (5121, 5123, 5125):
            raise DataError(
                scene.path, f"expected unsigned indices, got component type {entry['componentType']!r:.20}."
            )
        corners = read_accessor(scene, primitive["indices"], "SCALAR", normalize=False)[:, 0].astype(np.int64)
    else:
        scene.count(count)
        corners = np.arange(count)
    if len(corners) and corners.max() >= count:
        problem = f"holds no valid mesh: expected vertex indices in [0, {count}), got {corners.max()}."
        raise DataError(scene.path, problem)
    if mode == STRIP:
        return strip_triangles(corners)
    if mode == FAN:
        return fan_triangles(corners, np.array([len(corners)]))
    if len(corners) % 3:
        raise DataError(scene.path, f"expected three corners a triangle, got {len(corners)} corners.")
    return corners.reshape(-1, 3)


def _has_texture(scene: Scene, material: Any) -> bool:
    return "baseColorTexture" in scene.item("materials", material).get("pbrMetallicRoughness", {})


def read_accessor(scene: Scene, index: Any, kind: str, normalize: bool = True) -> np.ndarray:
    """Values ``(N, width)`` of an accessor, sparse ones put in: float64, or the stored type unless ``normalize``."""
    entry = scene.item("accessors", index)
    count = entry["count"]
    if entry.get("type") != kind or type(count) is not int or count < 0:
        raise DataError(
            scene.path, f"expected an accessor of type {kind}, got {entry.get('type')!r:.20} x {count!r:.20}."
        )
    scene.count(count)
    code, width = COMPONENTS[entry["componentType"]], WIDTHS[kind]
    if "bufferView" in entry:
        values = _view(scene, entry["bufferView"], entry.get("byteOffset", 0), count, code, width)
    elif "sparse" in entry:
        values = np.zeros((count, width), f"<{code}")
    else:
        raise DataError(scene.path, f"expected an accessor with data, got accessor {index} without.")
    if "sparse" in entry:
        sparse = entry["sparse"]
        of, to, number = sparse["indices"], sparse["values"], sparse["count"]
        if type(number) is not int or not 0 <= number <= count:
            raise DataError(scene.path, f"expected at most {count} sparse values, got {number!r:.20}.")
        at = COMPONENTS[of["componentType"]]
        places = _view(scene, of["bufferView"], of.get("byteOffset", 0), number, at, 1)[:, 0]
        if at[0] != "u" or (number and places.max() >= count):
            raise DataError(scene.path, f"expected sparse indices below {count}, got others.")
        values = values.copy()
        values[places] = _view(scene, to["bufferView"], to.get("byteOffset", 0), number, code, width)
    if not normalize:
        return values
    if entry.get("normalized") and code[0] in "iu":
        return np.maximum(values / np.float64(np.iinfo(code).max), -1)
    return values.astype(np.float64)


def _view(scene: Scene, index: Any, offset: Any, count: int, code: str, width: int) -> np.ndarray:
    """Values ``(count, width)`` of a buffer view, within its bounds and its buffer's."""
    view = scene.item("bufferViews", index)
    for name in set(COMPRESSED) & set(view.get("extensions", {})):
        raise _compressed(scene.path, name)
    buffer = _buffer(scene, view["buffer"])
    start, length = view.get("byteOffset", 0), view["byteLength"]
    size = np.dtype(code).itemsize * width
    stride = view.get("byteStride", size)
    if any(type(number) is not int or number < 0 for number in (offset, start, length, stride)) or stride < size:
        raise DataError(scene.path, f"expected offsets and strides of at least {size} bytes, got others.")
    if start + length > len(buffer) or (count and offset + (count - 1) * stride + size > length):
        problem = f"expected {count} values in bufferViews[{index}], it promises more than its {len(buffer)} bytes."
        raise DataError(scene.path, problem, "Hint: export or download it again.")
    return np.ndarray((count, width), f"<{code}", buffer, start + offset, (stride, np.dtype(code).itemsize))


def _buffer(scene: Scene, index: Any) -> bytes:
    """Bytes of a buffer: the binary chunk, a data URI, or a file beside this one."""
    if index in scene.buffers:
        return scene.buffers[index]
    entry = scene.item("buffers", index)
    uri = entry.get("uri")
    if uri is None:
        if index != 0 or -1 not in scene.buffers:
            problem = f"expected the data of buffers[{index}], got none: compressed or damaged."
            raise DataError(scene.path, problem, "Hint: export or download it again.")
        data = scene.buffers[-1]
    elif str(uri).startswith("data:"):
        head, _, text = uri.partition(",")
        try:
            data = base64.b64decode(text, validate=True) if head.endswith(";base64") else b""
        except (binascii.Error, ValueError) as error:
            raise DataError(scene.path, f"expected base64 in buffers[{index}], got other text.") from error
    else:
        data = _neighbour(scene.path, str(uri)).read_bytes()
        scene.limit += len(data)
    scene.buffers[index] = data
    return data


def _neighbour(path: Path, uri: str) -> Path:
    """The file that a relative URI names, in the folder of the file or below; `DataError` for any other."""
    folder, name = path.parent.resolve(), unquote(uri)
    if "\0" in name or ":" in name or "\\" in name or name.startswith("/"):
        problem = f"expected a buffer in its own folder, got the URI {uri!r:.100}: not opened."
        raise DataError(path, problem, "Hint: export it as .glb, which holds everything.")
    file = (folder / name).resolve()
    if not file.is_relative_to(folder):
        problem = f"expected a buffer in its own folder, got the URI {uri!r:.100}: not opened."
        raise DataError(path, problem, "Hint: export it as .glb, which holds everything.")
    if not file.is_file():
        problem = f"expected its buffer {uri!r:.100} beside it, there is none."
        raise DataError(path, problem, "Hint: copy it there, or export as .glb, which holds everything.")
    check_file(file, MAX_BYTES)
    return file


def _join(scene: Scene, parts: list[Part]) -> RawSurface:
    """One surface of all parts; colours and normals where all parts have them."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    for name, what in (("colors", "Colours"), ("normals", "Normals")):
        having = sum(getattr(part, name) is not None for part in parts)
        if 0 < having < len(parts):
            scene.note(f"{what} are left out: {having} of {len(parts)} parts have them.")

    def joined(name: str) -> np.ndarray | None:
        values = [getattr(part, name) for part in parts]
        return None if any(value is None for value in values) else np.concatenate(values)

    faces = None
    if parts[0].faces:
        faces = np.concatenate([piece + offset for part, offset in zip(parts, offsets) for piece in part.faces])
    return RawSurface(scene.path, joined("vertices"), faces, joined("normals"), joined("colors")).noted(*scene.notes)
