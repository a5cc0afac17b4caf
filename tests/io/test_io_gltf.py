"""GLB and glTF files as other programs write them: nodes, primitives, accessors, skins, extensions, buffers."""

import base64
import json
import struct

import numpy as np
import pytest

from avatar.checks import DataError
from avatar.io.meshes import read_mesh
from avatar.io.surfaces import read_surface

CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
HALVES = [[0, 1, 2], [0, 2, 3]]
CODES = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Builder:
    """A document whose accessors are packed byte by byte."""

    def __init__(self, **document):
        self.data = b""
        self.document = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "nodes": [{"mesh": 0}]}
        self.document |= {"scenes": [{"nodes": [0]}], "scene": 0, "meshes": []} | document

    def view(self, code, rows, stride=0):
        self.data += b"\0" * (-len(self.data) % 4)
        start = len(self.data)
        for row in rows:
            packed = struct.pack(f"<{len(row)}{CODES[code]}", *row)
            self.data += packed.ljust(stride, b"\xff") if stride else packed
        entry = {"buffer": 0, "byteOffset": start, "byteLength": len(self.data) - start}
        self.document["bufferViews"].append(entry | ({"byteStride": stride} if stride else {}))
        return len(self.document["bufferViews"]) - 1

    def accessor(self, code, kind, rows, stride=0, **more):
        rows = [row if isinstance(row, tuple) else (row,) for row in rows]
        entry = {"bufferView": self.view(code, rows, stride), "componentType": code, "type": kind, "count": len(rows)}
        self.document["accessors"].append(entry | more)
        return len(self.document["accessors"]) - 1

    def mesh(self, *primitives):
        self.document["meshes"].append({"primitives": list(primitives)})
        return self

    def glb(self):
        binary = self.data + b"\0" * (-len(self.data) % 4)
        document = self.document | {"buffers": [{"byteLength": len(binary)}]}
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I", len(text)) + b"JSON" + text + struct.pack("<I", len(binary)) + b"BIN\0" + binary
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def square(indices=(0, 1, 2, 0, 2, 3), code=5123, mode=4, positions=CORNERS, **document):
    built = Builder(**document)
    primitive = {"attributes": {"POSITION": built.accessor(5126, "VEC3", positions)}, "mode": mode}
    if indices is not None:
        primitive["indices"] = built.accessor(code, "SCALAR", indices)
    return built.mesh(primitive)


def primitive_of(built):
    return built.document["meshes"][0]["primitives"][0]


def read(tmp_path, built, name="a.glb"):
    (tmp_path / name).write_bytes(built if isinstance(built, bytes) else built.glb())
    return read_surface(tmp_path / name)


@pytest.mark.parametrize("code", [5121, 5123, 5125])
def test_indices_of_every_size(tmp_path, code):
    surface = read(tmp_path, square(code=code))
    np.testing.assert_array_equal(surface.faces, HALVES)
    np.testing.assert_array_equal(surface.vertices, CORNERS)


@pytest.mark.parametrize(
    ("mode", "indices", "expected"),
    [
        (5, (0, 1, 3, 2), [[0, 1, 3], [3, 1, 2]]),
        (6, (0, 1, 2, 3), HALVES),
        (4, None, [[0, 1, 2]]),
        (5, None, [[0, 1, 2], [2, 1, 3]]),
        (6, None, HALVES),
    ],
)
def test_strips_fans_and_vertices_without_indices(tmp_path, mode, indices, expected):
    positions = CORNERS[:3] if mode == 4 else CORNERS
    np.testing.assert_array_equal(read(tmp_path, square(indices, mode=mode, positions=positions)).faces, expected)


def test_nodes_are_placed_by_their_chain_of_transforms(tmp_path):
    half = np.sqrt(0.5)
    nodes = [
        {"children": [1], "translation": [0, 10, 0]},
        {"children": [2, 3], "rotation": [0, 0, half, half]},  # a quarter turn around z
        {"mesh": 0, "scale": [2, 3, 1]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]},
        {"mesh": 0, "translation": [99, 99, 99]},  # not in the scene
    ]
    surface = read(tmp_path, square(nodes=nodes))
    x, y, z = np.array(CORNERS).T
    np.testing.assert_allclose(surface.vertices[:4], np.stack([-3 * y, 10 + 2 * x, z], axis=1), atol=1e-6)
    np.testing.assert_allclose(surface.vertices[4:], np.stack([-(y + 8), 10 + x + 7, z + 9], axis=1), atol=1e-6)
    np.testing.assert_array_equal(surface.faces, [*HALVES, [4, 5, 6], [4, 6, 7]])


def test_a_mirrored_node_keeps_the_outside_outside(tmp_path):
    built = square(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}])
    primitive_of(built)["attributes"]["NORMAL"] = built.accessor(5126, "VEC3", [(0, 0, 2)] * 4)
    surface = read(tmp_path, built)
    a, b, c = surface.vertices[surface.faces[0]]
    np.testing.assert_array_equal(np.cross(b - a, c - a), [0, 0, 1])
    np.testing.assert_array_equal(surface.normals, [[0, 0, 1]] * 4)


def test_primitives_that_share_vertices_share_them_still(tmp_path):
    built = square()
    other = primitive_of(built) | {"indices": built.accessor(5121, "SCALAR", (1, 2, 3))}
    own = {"attributes": {"POSITION": built.accessor(5126, "VEC3", CORNERS[:3])}}
    built.document["meshes"][0]["primitives"] += [other, own]
    surface = read(tmp_path, built)
    assert surface.vertices.shape == (7, 3)
    np.testing.assert_array_equal(surface.faces, [*HALVES, [1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("code", "kind", "color", "more"),
    [
        (5121, "VEC4", (255, 0, 51, 255), {"normalized": True}),
        (5123, "VEC3", (65535, 0, 13107), {"normalized": True}),
        (5126, "VEC4", (1, 0, 0.2, 1), {}),
        (5126, "VEC3", (1, 0, 0.2), {}),
    ],
)
def test_colours_of_every_kind(tmp_path, code, kind, color, more):
    built = square()
    primitive_of(built)["attributes"]["COLOR_0"] = built.accessor(code, kind, [color] * 4, **more)
    np.testing.assert_allclose(read(tmp_path, built).colors, [[1, 0, 0.2]] * 4, atol=1e-6)
    part = {"attributes": {"POSITION": built.accessor(5126, "VEC3", CORNERS[:3])}}
    built.document["meshes"][0]["primitives"].append(part)
    surface = read(tmp_path, built)
    assert surface.colors is None and surface.notes == ("Colours are left out: 1 of 2 parts have them.",)


def test_interleaved_and_sparse_accessors(tmp_path):
    built = Builder()
    position = built.accessor(5126, "VEC3", [(9, 9, 9), *CORNERS[1:]], stride=20)
    sparse = {"count": 1, "indices": {"bufferView": built.view(5123, [(0,)]), "componentType": 5123}}
    built.document["accessors"][position]["sparse"] = sparse | {
        "values": {"bufferView": built.view(5126, [CORNERS[0]])}
    }
    built.mesh({"attributes": {"POSITION": position}, "indices": built.accessor(5121, "SCALAR", (0, 1, 2, 0, 2, 3))})
    np.testing.assert_array_equal(read(tmp_path, built).vertices, CORNERS)


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("KHR_draco_mesh_compression", "copy"),
        ("EXT_meshopt_compression", "dequantize"),
        ("KHR_mesh_quantization", "dequantize"),
    ],
)
def test_compressed_geometry_is_refused_with_the_command_that_undoes_it(tmp_path, name, command):
    hint = rf"got geometry with {name}\. Hint: undo it with gltf-transform {command} 'my body.glb' plain\.glb"
    with pytest.raises(DataError, match=hint):
        read(tmp_path, square(extensionsRequired=[name]), "my body.glb")


def test_compressed_geometry_that_does_not_say_so_first_is_refused(tmp_path):
    built = square()
    del built.document["accessors"][0]["bufferView"]
    primitive_of(built)["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    with pytest.raises(DataError, match="KHR_draco_mesh_compression"):
        read(tmp_path, built)
    whole = Builder()
    position = whole.accessor(5122, "VEC3", [tuple(32767 * x for x in corner) for corner in CORNERS], normalized=True)
    whole.mesh({"attributes": {"POSITION": position}, "indices": whole.accessor(5121, "SCALAR", (0, 1, 2))})
    with pytest.raises(DataError, match="KHR_mesh_quantization"):
        read(tmp_path, whole)
    with pytest.raises(DataError, match="requires the extension XY_unknown"):
        read(tmp_path, square(extensionsRequired=["XY_unknown"]))
    read(tmp_path, square(extensionsRequired=["KHR_materials_unlit", "KHR_texture_transform"]))


def skinned(weights=((1, 0, 0, 0),) * 4, inverse=(0, 0, 0)):
    matrix = (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, *inverse, 1)
    built = square(
        nodes=[{"mesh": 0, "skin": 0, "translation": [50, 0, 0]}, {"translation": [0, 2, 0], "scale": [0.5] * 3}]
    )
    attributes = primitive_of(built)["attributes"]
    attributes["JOINTS_0"] = built.accessor(5121, "VEC4", [(0, 0, 0, 0)] * 4)
    attributes["WEIGHTS_0"] = built.accessor(5126, "VEC4", weights)
    built.document["skins"] = [{"joints": [1], "inverseBindMatrices": built.accessor(5126, "MAT4", [matrix])}]
    return built


def test_a_skinned_mesh_is_where_its_joints_are_not_where_its_node_is(tmp_path):
    surface = read(tmp_path, skinned(inverse=(0, -4, 0)))
    np.testing.assert_allclose(surface.vertices, np.array(CORNERS) * 0.5)
    assert surface.notes == (
        "A skinned mesh is read in the pose its joints are stored in; animations are not applied.",
    )
    with pytest.raises(DataError, match="expected skinning weights for all vertices"):
        read(tmp_path, skinned(weights=[(0, 0, 0, 0)] * 4))


def test_points_and_lines(tmp_path):
    built = square(None, mode=0)
    primitive_of(built)["attributes"]["NORMAL"] = built.accessor(5126, "VEC3", [(0, 1, 0)] * 4)
    np.testing.assert_array_equal(read(tmp_path, built).cloud.normals, [[0, 1, 0]] * 4)
    with pytest.raises(DataError, match="got a point cloud of 4 points"):
        read_mesh(tmp_path / "a.glb")
    both = square()
    lines = {"attributes": {"POSITION": both.accessor(5126, "VEC3", CORNERS)}, "mode": 1}
    both.document["meshes"][0]["primitives"] += [lines, lines | {"mode": 0}]
    surface = read(tmp_path, both)
    assert surface.vertices.shape == (4, 3)
    assert surface.notes == ("Lines are left out.", "4 points beside its triangles are left out.")


def test_textures_are_left_out_with_a_note(tmp_path):
    built = square(materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}])
    primitive_of(built)["material"] = 0
    assert read(tmp_path, built).notes == ("Textures are not read: no colours.",)


def gltf(tmp_path, uri, name="a.gltf"):
    built = square()
    document = built.document | {"buffers": [{"byteLength": len(built.data), "uri": uri}]}
    (tmp_path / name).write_text(json.dumps(document))
    return tmp_path / name, built.data


def test_gltf_with_data_in_itself_or_beside_itself(tmp_path):
    data = square().data
    path, _ = gltf(tmp_path, "data:application/octet-stream;base64," + base64.b64encode(data).decode())
    np.testing.assert_array_equal(read_surface(path).faces, HALVES)
    path, _ = gltf(tmp_path, "parts/the%20data.bin")
    with pytest.raises(DataError, match=r"its buffer 'parts/the%20data\.bin' beside it, there is none\. Hint: copy it"):
        read_surface(path)
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "the data.bin").write_bytes(data)
    np.testing.assert_array_equal(read_surface(path).faces, HALVES)


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "/etc/passwd",
        "file:///etc/passwd",
        "http://localhost/a.bin",
        "%2e%2e/secret.bin",
        "link.bin",
        "a\\b",
    ],
)
def test_nothing_outside_the_folder_is_opened(tmp_path, uri):
    folder = tmp_path / "scans"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(square().data)
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    path, _ = gltf(folder, uri)
    with pytest.raises(
        DataError, match=r"expected a buffer in its own folder, .*: not opened\. Hint: export it as \.glb"
    ):
        read_surface(path)


def broken(change):
    built = square()
    change(built.document)
    return built


BROKEN = {
    r"expected vertex indices in \[0, 4\), got 9": lambda: square((0, 1, 9)),
    "three corners a triangle, got 4": lambda: square((0, 1, 2, 3)),
    "expected triangles or points in its scene, got none": lambda: square(mode=1),
    "NaN or infinite": lambda: square(positions=[(np.nan, 0, 0), *CORNERS[1:]]),
    "promises 4000000000": lambda: broken(lambda of: of["accessors"][0].update(count=4_000_000_000)),
    "promises more than its": lambda: broken(lambda of: of["accessors"][0].update(count=5)),
    "accessor 0 without": lambda: broken(lambda of: of["accessors"][0].pop("bufferView")),
    "offsets and strides": lambda: broken(lambda of: of["bufferViews"][0].update(byteStride=0)),
    "offsets and strides of": lambda: broken(lambda of: of["bufferViews"][0].update(byteOffset=-4)),
    "unsigned indices": lambda: broken(lambda of: of["accessors"][1].update(componentType=5126)),
    r"expected accessors\[7\], got none": lambda: broken(lambda of: of["meshes"][0]["primitives"][0].update(indices=7)),
    "node 0 twice": lambda: broken(lambda of: of.update(nodes=[{"mesh": 0}, {"children": [0]}, {"children": [0]}])),
    "in a circle or twice": lambda: broken(lambda of: of.update(nodes=[{"children": [1]}, {"children": [0]}])),
    "expected glTF 2.0, got version 1.0": lambda: broken(lambda of: of.update(asset={"version": "1.0"})),
    "finite transforms": lambda: broken(lambda of: of.update(nodes=[{"mesh": 0, "scale": [np.inf, 1, 1]}])),
    "more than its .* bytes. Hint: export the mesh once": lambda: square(
        positions=CORNERS * 100, nodes=[{"children": list(range(1, 2000))}, *[{"mesh": 0}] * 1999]
    ),
    "EXT_mesh_gpu_instancing": lambda: broken(
        lambda of: of["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}})
    ),
    r"cannot be read as glTF 2\.0": lambda: broken(lambda of: of.update(meshes=[{"primitives": [{"attributes": []}]}])),
    r"cannot be read as glTF 2\.0 \(": lambda: broken(lambda of: of.update(nodes=[7], scenes=[])),
    "expected a GLB file": lambda: b"solid nothing at all",
    "its JSON is damaged": lambda: b"glTF" + struct.pack("<III", 2, 24, 4) + b"JSON{nil",
}


@pytest.mark.parametrize("reason", BROKEN)
def test_bad_files_are_named_with_their_reason(tmp_path, reason):
    with pytest.raises(DataError, match=reason) as caught:
        read(tmp_path, BROKEN[reason]())
    assert str(tmp_path / "a.glb") in str(caught.value)
