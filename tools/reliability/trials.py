"""Reliability trials by name, run one after the other; each result is saved as it ends, so that a long run resumes."""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from avatar.checks import AvatarError, check_name
from avatar.environment import prepared_process
from avatar.evaluation.scores import Scores, write_scores
from avatar.io.documents import read_json
from avatar.io.npz import write_whole
from avatar.pipeline.scores import current_commit
from reliability.corruption import flip_trial
from reliability.decompression_bombs import bomb_trial
from reliability.findings import Finding, to_score, to_table
from reliability.full_disks import disk_trial
from reliability.fuzzing import fuzz_trial
from reliability.hostile_names import name_trial
from reliability.killing import kill_trial
from reliability.meshing import mesh_trial
from reliability.nan_injection import nan_trial
from reliability.offline import network_trial
from reliability.payloads import payload_trial
from reliability.races import race_trial
from reliability.spoilt_data import spoilt_trial
from reliability.streaming import stream_trial

log = logging.getLogger(__name__)


@dataclass
class ReliabilityConfig:
    """Trials to run, their sizes, and folders; the defaults are those of the published table."""

    only: tuple[str, ...] = ()  # names of trials; all of them if empty
    kills: int = 50  # trainings killed by SIGKILL
    kills_in_saves: int = 15  # of these, between two system calls of a save
    flips: int = 1000  # bit flips of checkpoints, one at a time
    truncations: int = 200  # truncated checkpoints
    files: int = 10_000  # mutated files
    names: int = 200  # hostile names
    full_disks: int = 20
    injections: int = 30  # of NaN or infinity into trainings
    races: int = 50  # of two jobs for one run folder
    meshes: int = 1000  # frames meshed
    demo_minutes: float = 0.2  # training time of the demo without a network
    stream_gb: float = 10.0  # size of the outfit that is streamed
    stream_frames: int = 240  # frames of it that training reads
    seed: int = 0
    again: bool = False  # repeat finished trials of the same size
    root: Path = Path("runs/reliability")  # working folder; emptied trial by trial
    out: Path = Path("runs/tables")  # where the table's files go
    table: str = "reliability"  # name of the table's files there

    def __post_init__(self):
        check_name("table", self.table)
        unknown = [name for name in self.only if name not in TRIALS]
        if unknown:
            raise AvatarError(f"only: expected some of {', '.join(TRIALS)}, got {unknown[0]!r}.")
        for name in ("kills", "flips", "truncations", "files", "names", "full_disks", "injections", "races", "meshes"):
            if getattr(self, name) < 1:
                raise AvatarError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if not 0 <= self.kills_in_saves <= self.kills:
            raise AvatarError(f"kills_in_saves: expected 0 to {self.kills}, got {self.kills_in_saves}.")


TRIALS: dict[str, tuple[tuple[str, ...], Callable[[ReliabilityConfig, Path], list[Finding]]]] = {
    "kill": (("kills", "kills_in_saves"), lambda c, root: kill_trial(root, c.kills, c.kills_in_saves, c.seed)),
    "flips": (("flips", "truncations"), lambda c, root: flip_trial(root, c.flips, c.truncations, c.seed)),
    "disk": (("full_disks",), lambda c, root: disk_trial(root, c.full_disks, c.seed)),
    "nan": (("injections",), lambda c, root: nan_trial(root, c.injections, c.seed)),
    "race": (("races",), lambda c, root: race_trial(root, c.races)),
    "fuzz": (("files",), lambda c, root: fuzz_trial(root, c.files, c.seed)),
    "bombs": ((), lambda c, root: bomb_trial(root)),
    "payloads": ((), lambda c, root: payload_trial(root)),
    "names": (("names",), lambda c, root: name_trial(root, c.names, c.seed)),
    "spoilt": ((), lambda c, root: spoilt_trial(root, c.out)),
    "mesh": (("meshes",), lambda c, root: mesh_trial(c.meshes)),
    "stream": (("stream_gb", "stream_frames"), lambda c, root: stream_trial(root, c.stream_gb, c.stream_frames)),
    "network": (("demo_minutes",), lambda c, root: network_trial(root, c.demo_minutes)),
}


@prepared_process()
def check_reliability(config: ReliabilityConfig) -> Path:
    """Runs the chosen trials that are not finished yet; returns the table, ``<out>/reliability.md``.

    ``reliability.csv`` is written beside it, ``spoilt_data.md`` by the trial ``spoilt``. Trials finished earlier, with
    whatever sizes, keep their rows.

    Raises:
        AvatarError: at the end, when a finding missed its goal, naming the first.
    """
    torch.set_num_threads(1)  # before anything forks: children have none of a parent's threads
    root = config.root.resolve()
    for name in config.only or TRIALS:
        options, trial = TRIALS[name]
        counts = {option: getattr(config, option) for option in (*options, "seed")}
        done = root / f"{name}.json"
        if not config.again and done.is_file() and read_json(done)["counts"] == counts:
            log.info("%s: finished before.", name)
            continue
        log.info("%s: %s", name, ", ".join(f"{key}={value}" for key, value in counts.items()))
        shutil.rmtree(root / name, ignore_errors=True)
        started, commit = time.monotonic(), current_commit()
        findings = trial(config, root / name)
        seconds = time.monotonic() - started
        result = {"counts": counts, "seconds": seconds, "commit": commit}
        write_whole(done, json.dumps(result | {"findings": [asdict(f) for f in findings]}, indent=1).encode())
        log.info("%s", to_table(findings))
    return write_table(config)


def write_table(config: ReliabilityConfig) -> Path:
    """Writes the rows and the table of all trials finished in a root, in the order of `TRIALS`.

    Raises:
        AvatarError: when a finding missed its goal.
    """
    findings, rows = [], []
    for name in TRIALS:
        path = config.root / f"{name}.json"
        if path.is_file():
            result = read_json(path)
            found = [Finding(**values) for values in result["findings"]]
            findings += found
            rows += [
                to_score(finding, result["counts"]["seed"], result["seconds"], result["commit"]) for finding in found
            ]
    write_scores(config.out / f"{config.table}.csv", Scores(rows))
    path = config.out / f"{config.table}.md"
    write_whole(path, to_table(findings).encode())
    print(f"written: {config.out / config.table}.*")
    missed = [finding for finding in findings if not finding.met]
    if missed:
        first = missed[0]
        raise AvatarError(f"{first.trial}: {first.what}: {first.value:g} {first.unit}, the goal was {first.goal}.")
    return path
