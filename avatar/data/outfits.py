"""One interface to an outfit on disk, whatever its layout."""

from __future__ import annotations

import difflib
import logging
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np
import torch

from avatar.body.model import BodyModel
from avatar.checks import AvatarError, DataError, did_you_mean, sentences
from avatar.data.folders import SPLITS, VALIDATION
from avatar.data.scan_validation import check_frame
from avatar.data.validation import check_joints, check_pose, check_template
from avatar.io.ledger import digest_of, file_digest, files_digest
from avatar.records import BodyFit, Frame, Template

log = logging.getLogger(__name__)


class Outfit(ABC):
    """One person in one set of clothes: frames of scans with the body under them.

    Where the true surface is known, there are ``resample`` and ``load_mesh`` as well (`OpenOutfit`).
    """

    measured = True  # scans as a scanner gives them

    def __init__(self, path: Path, dataset: str = ""):
        self.held_back: tuple[str, ...] = ()
        self._doubted: set[str] = set()
        self.path = Path(path)
        self.name = self.path.name
        self.dataset = dataset or self.path.parent.name

    @cached_property
    def template(self) -> Template:
        """The body at rest in its canonical pose, float32, checked (`check_template`, `check_joints`)."""
        template = self._read_template()
        check_template(template, self.path)
        check_joints(template, self.path)
        return template

    def frames(self, split: str) -> tuple[str, ...]:
        """Names of the frames of a split, sorted.

        Raises `AvatarError` for an unknown split, or validation without frames held back; `DataError` for one without
        frames.
        """
        if split == VALIDATION and self.held_back:
            return self.held_back
        if split not in SPLITS:
            held = ", or validation where frames were held back from training" if split == VALIDATION else ""
            near = did_you_mean(split, (*SPLITS, VALIDATION))
            kinds = f"{', '.join(SPLITS[:-1])} or {SPLITS[-1]}"
            raise AvatarError(sentences(f"split: expected {kinds}{held}, got {split!r}.", near))
        if not self._listed[split]:
            there = (p for p in sorted((self.path / split).rglob("*")) if p.is_file() and not p.name.startswith("."))
            other = ", ".join(str(path.relative_to(self.path / split)) for path in islice(there, 3))
            found = f"found only {other}" if other else "found none"
            raise DataError(self.path / split, f"expected frames (*.npz), {found}.", "Make or download the data.")
        return self._listed[split]

    def has_frames(self, split: str) -> bool:
        """Whether there are frames of a split: data may come without a test folder, or with an empty one."""
        return bool(self._listed[split])

    def with_validation(self, names: Sequence[str]) -> Self:
        """The same outfit with some training frames as a split ``validation`` as well; `AvatarError` for others."""
        for name in names:
            self.frame_path("train", name)
        other = copy(self)
        other.held_back = tuple(names)
        return other

    def load(self, split: str, name: str) -> Frame:
        """One frame, checked: finite, in metres, scan over body.

        What is doubtful is logged, each kind of it once an outfit. Raises `AvatarError` for a frame that is not in the
        split, naming near ones; `DataError` for an invalid file.
        """
        path = self.frame_path(split, name)
        frame = self._read_frame(path, split, name)
        doubts = check_frame(frame, self.template, path, self.measured)
        for kind, doubt in doubts.items() if self.measured else ():
            self._doubt(kind, path, doubt)
        return frame

    def _doubt(self, kind: str, path: Path, doubt: str) -> None:
        """Logs what is doubtful about a file, the first time for its kind."""
        if kind not in self._doubted:
            self._doubted.add(kind)
            log.warning("%s: %s (Others like it are not mentioned.)", path, doubt)

    def load_body(self, split: str, name: str) -> BodyFit:
        """The body under a frame; errors as in `load`."""
        return self.load(split, name).body

    def frame_path(self, split: str, name: str) -> Path:
        """The file of one of the outfit's frames. Raises `AvatarError` for a name that is not among them."""
        names = self.frames(split)
        if name not in self._frame_sets.get(split, names):
            near = difflib.get_close_matches(name, names, n=3) or names[:3]
            raise AvatarError(f"frame: {self.name} has no {split} frame {name!r}; there are {', '.join(near)}, ...")
        return self.path / ("train" if split == VALIDATION else split) / f"{name}.npz"

    def digest(self, split: str, name: str) -> str:
        """One hash over all of a frame on the disk: its file, and the files that the outfit's frames share."""
        return digest_of([file_digest(self.frame_path(split, name)), self.shared_digest])

    @cached_property
    def shared_digest(self) -> str:
        """One hash over the files that the outfit's frames share."""
        return files_digest(self.path)

    @property
    @abstractmethod
    def body(self) -> BodyModel | None:
        """The subject's body, or None where the outfit has only a mesh of it, which cannot be posed."""

    @property
    def mean_body(self) -> BodyModel | None:
        """The body a pose encoder sees in place of the subject's: the mean shape where the data has it."""
        return self.body

    def posable_body(self) -> BodyModel:
        """The subject's body. Raises `DataError` where there is only a mesh."""
        if self.body is None:
            problem = "posing needs skinning weights and joints, and there is only template.obj."
            hint = "Add your own SMPL-family body: python tools/convert_body.py <downloaded file> template.npz."
            raise DataError(self.path, problem, hint)
        return self.body

    @torch.no_grad()
    def fit_pose(self, pose: np.ndarray, translation: np.ndarray | None = None) -> BodyFit:
        """The subject in any pose; what a pose encoder sees of it is in mean shape, with the root at rest.

        ``pose (J, 3)`` axis-angle, radians, relative to the parent and to the T-pose; ``translation (3,)`` metres, zero
        if None. Raises `AvatarError` for a pose of other joints, or where the outfit has no body that can be posed.
        """
        body = self.posable_body()
        check_pose(pose, len(body.parents))
        translation = np.asarray(np.zeros(3) if translation is None else translation, np.float32)
        pose = np.asarray(pose, np.float32)
        turned = torch.from_numpy(pose)[None]
        posed = body(turned, torch.from_numpy(translation)[None])
        rootless = turned.clone()
        rootless[:, 0] = body.canonical_pose[0]
        parts = {name: value[0].numpy() for name, value in vars(posed).items()}
        seen = self.mean_body(rootless).vertices[0].numpy()
        return BodyFit(**parts, pose_vertices=seen, translation=translation, pose=pose)

    @cached_property
    def _listed(self) -> dict[str, tuple[str, ...]]:
        return {
            split: tuple(sorted(p.stem for p in (self.path / split).glob("*.npz") if not p.name.startswith(".")))
            for split in SPLITS
        }

    @cached_property
    def _frame_sets(self) -> dict[str, frozenset[str]]:
        """The same names for look-ups."""
        return {split: frozenset(names) for split, names in self._listed.items()}

    @abstractmethod
    def _read_template(self) -> Template:
        """The body at rest, from the layout's files."""

    @abstractmethod
    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        """One frame, from the layout's file."""
