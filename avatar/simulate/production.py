"""Producing an outfit: its frames, one independent run each, over processes, resumable."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
import yaml

from avatar import __version__
from avatar.body.model import BodyModel
from avatar.body.open import open_body
from avatar.body.packed import packed_body, write_body
from avatar.checks import DataError
from avatar.io.frames import OpenGarment, read_open_frame, read_open_garment, write_manifest, write_open_garment
from avatar.io.ledger import Ledger, digest_of, file_digest
from avatar.processes import in_workers
from avatar.progress import tracked
from avatar.records import Motion
from avatar.simulate.dressing import DressedBody, TravelConfig
from avatar.simulate.gates import FrameReport, GateConfig, frames_of, record_frame, record_motion
from avatar.simulate.outfits import OutfitConfig
from avatar.simulate.poses import NamedPose

Job = NamedPose | Motion  # a pose to settle in, or a sequence to play


class FrameLedger:
    """Finished frames of an outfit's folder: by hash, and by the pose, garment and history they are made from.

    A valid frame that no ledger lists, as an interrupted run leaves it, is taken over.
    """

    def __init__(self, folder: Path, vertices: int):
        self.folder, self.vertices = folder, vertices
        self.ledger, self.garment = Ledger(folder), file_digest(folder / "garment.npz")

    def has(self, path: Path, pose: np.ndarray, history: int = 0) -> bool:
        """Whether a frame is there as it was written."""
        name, key = self._identify(path, pose, history)
        if name in self.ledger.entries or not is_valid(path, pose, self.vertices, history):
            return self.ledger.find(name, key) is not None
        self.ledger.record(name, key, [path])
        return True

    def note(self, path: Path, pose: np.ndarray, history: int = 0) -> None:
        """Records a frame that was made, if it passed its gates and was written."""
        if path.is_file():
            self.ledger.record(*self._identify(path, pose, history), [path])

    def _identify(self, path: Path, pose: np.ndarray, history: int) -> tuple[str, str]:
        """A frame's name and key."""
        made_of = {"pose": np.asarray(pose, np.float32).tolist(), "garment": self.garment}
        made_of |= {"history": history} if history else {}
        return path.relative_to(self.folder).as_posix(), digest_of(made_of)


def is_valid(path: Path, pose: np.ndarray, vertex_count: int, history: int = 0) -> bool:
    """Whether a frame is there, readable, of this pose, this outfit and this history."""
    try:
        frame = read_open_frame(path)
    except DataError:
        return False
    same = np.array_equal(frame.pose, np.asarray(pose, np.float32)) and frame.history == history
    return same and len(frame.cloth) == vertex_count


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: a process a core is faster, and its sums are the same on every machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def dress(outfit: OutfitConfig, travel: TravelConfig) -> DressedBody:
    """A body in an outfit."""
    return DressedBody(subject(outfit.shape), outfit, travel)


def subject(shape: str) -> BodyModel:
    """The open body in one of its shapes, or a body of its topology from a file of tools/make_body.py.

    Raises:
        DataError: for a damaged file or a body of another topology.
    """
    if not shape.endswith(".npz"):
        return open_body(shape)
    body = packed_body(Path(shape))
    if not torch.equal(body.faces, open_body().faces):
        raise DataError(Path(shape), "faces: expected those of the open body.", "Make it with tools/make_body.py.")
    return body


def write_outfit(dressed: DressedBody, folder: Path, gates: GateConfig) -> None:
    """Writes what all frames share: ``garment.npz`` with the cloth settled in the T-pose, and ``outfit.yaml``.

    Raises:
        DataError: when the folder holds frames of a garment other than the one that would be written.
    """
    outfit = dressed.outfit
    if (folder / "garment.npz").is_file():
        there = read_open_garment(folder / "garment.npz")
        if not np.array_equal(there.faces, dressed.faces):
            hint = "Choose another root or remove it."
            raise DataError(folder, "it holds frames of the same outfit cut otherwise.", hint)
        if (folder / "outfit.yaml").is_file():
            return
    canonical = dressed.settle(np.zeros_like(dressed.start_pose)).cloth
    folder.mkdir(parents=True, exist_ok=True)
    body = {"model": "open", "shape": outfit.shape, "canonical": "t"}
    if outfit.shape.endswith(".npz"):
        body = {"model": "packed", "canonical": "t"}
        write_body(folder / "body.npz", dressed.body)
    names = tuple(garment.name for garment in outfit.garments)
    write_open_garment(folder / "garment.npz", OpenGarment(dressed.faces, canonical, dressed.labels, names))
    text = {
        "name": outfit.name,
        "body": body,
        "units": "metres",
        "up": "y",
        "licence": "CC0-1.0",
        "garments": [asdict(garment) for garment in outfit.garments],
        "travel": asdict(dressed.travel),
        "gates": asdict(gates),
        "versions": {"avatar": __version__} | {name: version(name) for name in ("newton", "warp-lang", "numpy")},
    }
    (folder / "outfit.yaml").write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")


_worker: dict[str, object] = {}  # what a worker process keeps between frames


def _start_worker(outfit: OutfitConfig, travel: TravelConfig, gates: GateConfig) -> None:
    """Dresses the body once in a worker process, on one thread."""
    torch.set_num_threads(1)
    _worker["dressed"], _worker["gates"] = dress(outfit, travel), gates


def _record_in_worker(job: Job, folder: Path) -> list[FrameReport]:
    """One frame or sequence in a worker process."""
    return record(_worker["dressed"], job, folder, _worker["gates"])


def record(dressed: DressedBody, job: Job, folder: Path, gates: GateConfig) -> list[FrameReport]:
    """Writes a settled frame, or all frames of a sequence, into a split's folder."""
    if isinstance(job, Motion):
        return record_motion(dressed, job, folder, gates)
    return [record_frame(dressed, job, folder / f"{job.name}.npz", gates)]


def simulate_outfit(
    outfit: OutfitConfig,
    folder: Path,
    work: dict[str, Sequence[Job]],
    workers: int = 1,
    travel: TravelConfig | None = None,
    gates: GateConfig | None = None,
    progress: bool = True,
) -> list[FrameReport]:
    """Simulates and writes an outfit's frames; those finished are kept, so that a run resumes.

    Every pose is settled by itself; every frame of a motion follows from the one before. Sequences resume as a whole,
    and their frames are written where they miss a gate too, since a gap would break the sequence.

    Args:
        outfit: what is worn, by which body.
        folder: the outfit's folder; frames go to ``<folder>/<split>/<sequence>.<frame>.npz``.
        work: poses or motions of each split.
        workers: processes; 1 works in this one.
        travel, gates: settings; defaults if None.
        progress: whether to show a progress bar.

    Returns:
        A report of every frame made in this run, with the gates that it ``failed``.
    """
    travel, gates = travel or TravelConfig(), gates or GateConfig()
    with one_thread():
        dressed = dress(outfit, travel)
        write_outfit(dressed, folder, gates)
        done = FrameLedger(folder, len(dressed.labels))

        def frames(job: Job, place: Path) -> list[tuple[Path, np.ndarray, int]]:
            named = frames_of(job) if isinstance(job, Motion) else [job]
            return [(place / f"{frame.name}.npz", frame.pose, history) for history, frame in enumerate(named)]

        jobs = [(job, folder / split) for split, jobs in work.items() for job in jobs]
        jobs = [job for job in jobs if not all(done.has(*frame) for frame in frames(*job))]
        what = f"simulate {outfit.name} on {outfit.shape}, {len(dressed.labels):,} cloth vertices"
        bar = {"total": len(jobs), "what": what, "silent": not progress}
        if workers == 1 or len(jobs) < 2:
            made = ((job, record(dressed, *job, gates)) for job in jobs)
        else:
            made = in_workers(_record_in_worker, jobs, workers, _start_worker, (outfit, travel, gates))
        reports = []
        with closing(made):
            for job, found in tracked(made, **bar):
                reports += found
                for frame in frames(*job):
                    done.note(*frame)
    write_manifest(folder)
    return reports
