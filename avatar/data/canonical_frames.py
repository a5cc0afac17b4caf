"""An outfit seen at rest: its frames with the canonicalizer's T-pose scans in place of the posed ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from avatar.body.model import BodyModel
from avatar.checks import DataError
from avatar.data.outfits import Outfit
from avatar.io.canonical_scans import read_canonical_scan
from avatar.records import Frame, Scan, Template


class CanonicalOutfit(Outfit):
    """The frames of an outfit in its canonical space (SCANimate 3.1), for training there.

    A frame's scan is the canonical one and its body stands under it: the template's vertices, identity vertex
    transforms. What tells the pose stays that of the posed frame: ``pose_vertices``, ``joint_transforms``, ``pose``.
    """

    def __init__(self, posed: Outfit, scans: Path):
        """Takes an outfit and the folder of its canonical scans, ``<scans>/<split>/<frame>.npz``."""
        super().__init__(posed.path, posed.dataset)
        self.posed, self.scans = posed, Path(scans)

    @property
    def body(self) -> BodyModel | None:
        """The subject's body."""
        return self.posed.body

    @property
    def mean_body(self) -> BodyModel | None:
        """The body a pose encoder sees."""
        return self.posed.mean_body

    def frame_path(self, split: str, name: str) -> Path:
        """The canonical scan of one of the outfit's frames. Raises `AvatarError` for a name that is not among them."""
        return self.scans / split / super().frame_path(split, name).name

    @cached_property
    def _still(self) -> np.ndarray:
        """A vertex transform that moves nothing for each vertex, ``(V, 4, 4)``; one array for all frames."""
        return np.tile(np.eye(4, dtype=np.float32), (len(self.template.vertices), 1, 1))

    def _read_template(self) -> Template:
        return self.posed.template

    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        if not path.is_file():
            raise DataError(path, "no canonical scan of this frame.", "Run tools/canonicalize.py to its end.")
        stored, posed = read_canonical_scan(path), self.posed.load(split, name)
        body = replace(posed.body, vertices=self.template.vertices.numpy(), vertex_transforms=self._still)
        return replace(posed, body=body, scan=Scan(stored.points, stored.normals, stored.faces, colors=stored.colors))
