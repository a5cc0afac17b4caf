"""The sphere of `spheres` with an atlas: a front and a back island, cut apart along the equator seen from +z."""

from dataclasses import replace

import torch
from spheres import TEMPLATE

from avatar.geometry.uv import seam_edges
from avatar.records import SurfaceSamples, Template

CENTRES = torch.tensor([[0.25, 0.5], [0.75, 0.5]])


def cut_sphere() -> Template:
    vertices, faces = TEMPLATE.vertices, TEMPLATE.faces
    back = vertices[faces].mean(dim=1)[:, 2] < 0
    uv = torch.cat([vertices[:, :2] * 0.24 + centre for centre in CENTRES])
    return replace(TEMPLATE, uv=uv, uv_faces=faces + back[:, None] * len(vertices))


ATLASED = cut_sphere()


def both_sides_of_a_seam() -> SurfaceSamples:
    """Two samples of one and the same surface point, on an edge of a seam, seen from the triangles at its sides."""
    ends = seam_edges(ATLASED.faces, ATLASED.uv_faces)[3]
    shared = torch.isin(ATLASED.faces, ends)
    sides = (shared.sum(dim=1) == 2).nonzero()[:, 0]
    return SurfaceSamples(ATLASED.faces[sides], shared[sides].float() / 2, sides)
