"""A reader of rigged glTF files of its own, straight from the specification."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

gltf = pytest.importorskip("pygltflib")

DTYPES = {5126: "<f4", 5125: "<u4", 5121: "u1"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """A file's arrays, its nodes at a key frame, and its skinned vertices."""

    def __init__(self, path):
        self.file = gltf.GLTF2().load(path)
        self.blob = self.file.binary_blob()

    def array(self, accessor_id):
        accessor = self.file.accessors[accessor_id]
        view = self.file.bufferViews[accessor.bufferView]
        dtype, width = np.dtype(DTYPES[accessor.componentType]), WIDTHS[accessor.type]
        start = view.byteOffset + (accessor.byteOffset or 0)
        assert start % dtype.itemsize == 0 and view.byteOffset % 4 == 0
        assert view.byteLength == accessor.count * width * dtype.itemsize
        assert start + view.byteLength <= self.file.buffers[0].byteLength <= len(self.blob)
        return np.frombuffer(self.blob, dtype, accessor.count * width, start).reshape(accessor.count, width)

    def influences(self, attributes):
        """Weights and joints of each vertex, over all sets."""
        sets = [index for index in range(4) if getattr(attributes, f"WEIGHTS_{index}", None) is not None]
        weights = [self.array(getattr(attributes, f"WEIGHTS_{index}")) for index in sets]
        chosen = [self.array(getattr(attributes, f"JOINTS_{index}")) for index in sets]
        return np.concatenate(weights, axis=1), np.concatenate(chosen, axis=1)

    def world(self, frame):
        """World matrices of all nodes at a key frame (at rest for None)."""
        local = {}
        for index, node in enumerate(self.file.nodes):
            local[index] = {"translation": node.translation or [0, 0, 0], "rotation": node.rotation or [0, 0, 0, 1]}
        if frame is not None:
            for channel in self.file.animations[0].channels:
                sampler = self.file.animations[0].samplers[channel.sampler]
                local[channel.target.node][channel.target.path] = self.array(sampler.output)[frame]
        parents = {child: index for index, node in enumerate(self.file.nodes) for child in node.children or []}

        def matrix(index):
            here = np.eye(4)
            here[:3, :3] = Rotation.from_quat(local[index]["rotation"]).as_matrix()
            here[:3, 3] = local[index]["translation"]
            return matrix(parents[index]) @ here if index in parents else here

        return np.stack([matrix(index) for index in range(len(self.file.nodes))])

    def skinned(self, frame):
        """Vertices at a key frame, by the skinning formula of the specification."""
        skin, attributes = self.file.skins[0], self.file.meshes[0].primitives[0].attributes
        inverse_binds = self.array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        joints = self.world(frame)[skin.joints] @ inverse_binds
        weights, chosen = self.influences(attributes)
        blended = np.einsum("vk,vkij->vij", weights, joints[chosen])
        positions = self.array(attributes.POSITION)
        return np.einsum("vij,vj->vi", blended[:, :3, :3], positions) + blended[:, :3, 3]
