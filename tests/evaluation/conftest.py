"""A small outfit whose surfaces are spheres, so that every score has a closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from avatar.records import BodyFit, Frame, Scan

BODY_RADIUS, CLOTH_RADIUS = 0.9, 1.0


def sphere_points(count, radius, seed):
    """Independent uniform points on a sphere with outward normals, float32 as on disk."""
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (normals * radius).astype(np.float32), normals.astype(np.float32)


class SphereOutfit:
    """Frames of a sphere of cloth around a sphere of body, both moving up a metre a frame squared."""

    name, dataset = "ball", "spheres"

    def __init__(self, names=("walk.0000", "walk.0001", "walk.0002", "reach.0007"), points=3000):
        body = trimesh.creation.icosphere(subdivisions=4, radius=BODY_RADIUS)
        self.names, self.points, self.vertices = names, points, np.array(body.vertices)
        self.template = SimpleNamespace(faces=np.array(body.faces))

    def frames(self, split):
        return self.names if split == "test" else ()

    def load(self, split, name):
        eye = np.eye(4)[None]
        fit = BodyFit(self.vertices, np.repeat(eye, len(self.vertices), 0), eye, self.vertices, np.zeros(3))
        return Frame(name, self.name, split, fit, self.resample(split, name, self.points, seed=0))

    def resample(self, split, name, points, seed):
        return Scan(*sphere_points(points, CLOTH_RADIUS, [seed, *name.encode()]))


@pytest.fixture
def ball():
    return SphereOutfit()


@pytest.fixture
def ball_without_truth():
    """The same outfit from a dataset that does not have the true surface."""
    outfit = SphereOutfit()
    outfit.resample = None
    outfit.load = lambda split, name: SphereOutfit().load(split, name)
    return outfit


@pytest.fixture
def sphere_cloud():
    return sphere_points
