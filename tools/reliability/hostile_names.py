"""`names`: hostile file names at every entry point; nothing may be written outside the data and run roots."""

from __future__ import annotations

import json
import os
import random
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from avatar.checks import AvatarError
from avatar.data.layouts import find_outfit
from avatar.io.checkpoints import load_checkpoint
from avatar.io.frames import check_manifest
from avatar.io.ledger import digest_of
from avatar.methods.settings import FitConfig, RunConfig
from avatar.pipeline.reporting import CompareConfig
from avatar.pipeline.scores import PredictConfig, predict
from avatar.pipeline.surfaces import ExportConfig, MeshConfig, mesh
from avatar.runs.training import save_settings
from avatar.settings import settings_from_dict, settings_to_dict
from reliability.findings import Finding, none_of
from reliability.small_jobs import (
    DATASET,
    OUTFIT,
    canonicalizer_config,
    folder_of,
    prepare,
    run_config,
    train_job,
)
from reliability.workers import call_in_process

STEMS = (
    "..", "../..", "../../..", "../up", "a/../../up", "/", "/tmp/up", "//up", "~", "~root", "~/up", ".", "./up", ".up",
    "", " ", "\t", "\n", "a\nb", "a\0b", "\0", "C:", "C:\\up", "\\\\host\\up", "..\\up", "a\\..\\..\\up", "%2e%2e/up",
    "..%2fup", "\u2024\u2024/up", "\uff0e\uff0e/up", "\u2025/up", "a\u202eb", "na\u00efve", "\u0430dress", "con", "nul",
    "a:b", "a|b", "a;id", "$(id)", "`id`", "${HOME}", "-rf", "--help", "*", "?", "[a]", "a b", "a'b", 'a"b', "x" * 65,
    "x" * 300, "x" * 5000, "../" * 40 + "up", "up/" * 40, "file:///up", "link", "link/up", "data", "runs", ".git",
)  # fmt: skip
PARTS = ("../", "/", "\\", ".", "..", "a", "~", "\0", "%", "up", " ", "é")
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def hostile_names(count: int, seed: int) -> list[str]:
    """Names with path traversal, absolute, hidden, empty, too long, links, of other systems or other alphabets."""
    rng, names = random.Random(seed), list(STEMS)
    while len(names) < count:
        names.append("".join(rng.choice(PARTS) for _ in range(rng.randint(2, 9))))
    return names[:count]


def name_trial(root: Path, count: int, seed: int) -> list[Finding]:
    """Gives every name to every entry point, in a process whose writes the interpreter's audit hook records."""
    call_in_process(prepare, root)
    call_in_process(train_job, "closet", root, "named")
    names = hostile_names(count, seed)
    found = call_in_process(try_names, root, names, timeout=3600)
    (root / "names.json").write_text(json.dumps(found, indent=1))
    outside, untyped = (len(found[key]) for key in ("outside", "untyped"))
    return [
        none_of("names", "names by which anything was written outside the roots", outside, count),
        none_of("names", "names that ended in an untyped error", untyped, count),
        Finding("names", "entry points that each was given to", len(EntryPoints(root).all()), "entry points", count),
    ]


def try_names(root: Path, names: list[str]) -> dict[str, list[str]]:
    """Names by which something was written outside ``data`` and ``runs`` below the root, and those that crashed."""
    allowed = [(root / part).resolve() for part in ("data", "runs")]
    written: list[str] = []
    (root / "data" / "link").unlink(missing_ok=True)
    (root / "data" / "link").symlink_to("/tmp")
    for entry_point in EntryPoints(root).all():  # what libraries write as they are first loaded is not counted
        with suppress(AvatarError):
            entry_point("harmless")
    sys.addaudithook(lambda event, arguments: written.extend(places_written(event, arguments)))
    outside, untyped = [], []
    for name in names:
        written.clear()
        for entry_point in EntryPoints(root).all():
            try:
                entry_point(name)
            except AvatarError:
                continue
            except Exception as error:
                untyped.append(f"{name!r} {error!r:.300}")
        stray = [path for path in written if not any(Path(os.path.realpath(path)).is_relative_to(a) for a in allowed)]
        outside += [f"{name!r} {stray[:3]}"] if stray else []
    return {"outside": outside, "untyped": untyped}


def places_written(event: str, arguments: tuple[Any, ...]) -> list[str]:
    """Paths that an audit event writes to, makes, renames or removes."""
    if event == "open":
        path, mode, flags = arguments
        writes = bool(flags & WRITING) if isinstance(flags, int) else bool(set(str(mode)) & set("wax+"))
        return [os.fsdecode(path)] if writes and isinstance(path, (str, bytes)) else []
    if event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate"):
        return [os.fsdecode(arguments[0])] if not isinstance(arguments[0], int) else []
    if event in ("os.rename", "os.link", "os.symlink"):
        return [os.fsdecode(path) for path in arguments[:2]]
    return []


class EntryPoints:
    """Entry points of names: settings, untrusted files, and the names inside them."""

    def __init__(self, root: Path):
        self.root, self.run = root, folder_of("closet", root, "named")
        self.plain = settings_to_dict(run_config("closet", root))

    def all(self) -> list[Callable[[str], Any]]:
        """Entry points as functions of the name."""
        root, save = self.root, self.save_run
        return [
            lambda name: save(name=name),
            lambda name: save(dataset=name),
            lambda name: save(outfit=[name]),
            lambda name: save(outfit=["tee", name]),
            lambda name: save(method=self.plain["method"] | {"variant": name}),
            lambda name: save(canonical=name),
            lambda name: save_settings(canonicalizer_config(root, name)),
            lambda name: FitConfig(outfit=name, runs_root=root / "runs"),
            lambda name: find_outfit(root / "data", name, OUTFIT),
            lambda name: find_outfit(root / "data", DATASET, name),
            lambda name: mesh(MeshConfig(run=self.run, predictions=name)),
            lambda name: ExportConfig(run=self.run, predictions=name),
            lambda name: CompareConfig(table=name),
            self.write_run,
            self.name_motion,
            self.list_checkpoint,
            self.list_data,
        ]

    def save_run(self, **changes: Any) -> None:
        """Settings of a run, written to the folder they name."""
        save_settings(settings_from_dict(RunConfig, self.plain | changes))

    def write_run(self, name: str) -> None:
        """An untrusted run whose description gives its outfit, its run and its data set this name."""
        folder = self.root / "runs" / "untrusted"
        shutil.copytree(self.run, folder, dirs_exist_ok=True)
        description = json.loads((self.run / "avatar.json").read_text())
        for change in ({"outfit": [name]}, {"name": name}, {"dataset": name}):
            (folder / "avatar.json").write_text(json.dumps(description | {"config": description["config"] | change}))
            with suppress(AvatarError):
                mesh(MeshConfig(run=folder, formats=("ply",)))

    def name_motion(self, name: str) -> None:
        """A motion whose file gives it this name."""
        path = self.root / "runs" / "motion.npz"
        arrays = {"poses": np.zeros((1, 22, 3), np.float32), "translations": np.zeros((1, 3), np.float32)}
        np.savez(path, **arrays, fps=np.array(30.0), format=np.array("motion/1"), name=np.array(name))
        predict(PredictConfig(run=self.run, motion=path, points=1000, device="cpu"))

    def list_checkpoint(self, name: str) -> None:
        """A checkpoint that a manifest with a valid hash says is elsewhere."""
        folder = self.root / "runs" / "listed"
        folder.mkdir(exist_ok=True)
        entries = {"last": [{"file": name, "step": 1, "score": None, "sha256": "0" * 64}]}
        (folder / "manifest.json").write_text(json.dumps({**entries, "sha256": digest_of(entries)}))
        load_checkpoint(folder)

    def list_data(self, name: str) -> None:
        """A data set whose manifest lists this file."""
        folder = self.root / "data" / "listed"
        folder.mkdir(exist_ok=True)
        files = {name: {"size": 0, "sha256": ""}}
        (folder / "manifest.json").write_text(json.dumps({"format": "manifest/1", "files": files}))
        check_manifest(folder)
