"""`fuzz`: thousands of spoilt files through every reader; each is either sound or refused by one named error."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import torch

from avatar.checks import AvatarError
from avatar.io.npz import write_whole
from reliability.findings import Finding, none_of
from reliability.formats import FORMATS, forge
from reliability.mutations import INSIDE, MUTATORS
from reliability.workers import peak_memory

HANG_S = 10.0
MEMORY = 2 << 30  # bytes resident a reader may take at most
ADDRESS_SPACE = 16 << 30  # bytes; a reader that wants more is stopped before the machine is


@dataclass(frozen=True)
class Verdict:
    """What became of one file: ``kind`` sound, refused, unsound, untyped, unnamed, crash or hang, and why."""

    format: str
    mutator: str
    number: int
    kind: str
    why: str = ""
    peak: int = 0


def fuzz_trial(root: Path, files: int, seed: int) -> list[Finding]:
    """Spoils good files of every format by every mutator in turn and reads them in a process that may die.

    What was neither sound nor refused is written down in ``<root>/fuzz.json``, with the number that makes it again.
    """
    shutil.rmtree(root / "fuzz", ignore_errors=True)
    verdicts: list[Verdict] = []
    while len(verdicts) < files:
        verdicts += read_until_death(root / "fuzz", len(verdicts), files, seed)
    bad = [vars(verdict) for verdict in verdicts if verdict.kind not in ("sound", "refused")]
    write_whole(root / "fuzz.json", json.dumps(bad, indent=1).encode())
    counts = Counter(verdict.kind for verdict in verdicts)
    peak = max(verdict.peak for verdict in verdicts)
    return [
        none_of("fuzz", "files that crashed the reader", counts["crash"], files),
        none_of("fuzz", "that took it more than 10 s", counts["hang"], files),
        none_of("fuzz", "unsound and accepted, by an independent judge", counts["unsound"], files),
        none_of("fuzz", "refused by another error than ours", counts["untyped"], files),
        none_of("fuzz", "refused without the file's name", counts["unnamed"], files),
        Finding("fuzz", "refused with file and reason", counts["refused"], f"of {files}", files),
        Finding("fuzz", "read, and sound", counts["sound"], f"of {files}", files),
        Finding("fuzz", "peak resident memory of the reader", round(peak / 2**20), "MiB", files, None, MEMORY / 2**20),
    ]


def read_until_death(folder: Path, first: int, files: int, seed: int) -> list[Verdict]:
    """Verdicts on files from ``first`` on, until all are read or the reading process dies or hangs."""
    near, far = get_context("fork").Pipe()
    process = get_context("fork").Process(target=read_spoilt_files, args=(far, folder, first, files, seed), daemon=True)
    process.start()
    far.close()
    verdicts: list[Verdict] = []
    while first + len(verdicts) < files:
        kind = ""
        if not near.poll(HANG_S):
            kind = "hang"
        else:
            try:
                verdicts.append(Verdict(**json.loads(near.recv_bytes())))
            except (EOFError, OSError):
                kind = "crash"
        if kind:
            number = first + len(verdicts)
            process.kill()
            process.join()
            why = f"exit code {process.exitcode}"
            verdicts.append(Verdict(*case_of(number), number, kind, why))
            break
    process.join(1)
    process.kill()
    near.close()
    return verdicts


def case_of(number: int) -> tuple[str, str]:
    """Format and mutator of a file's number."""
    names, ways = list(FORMATS), [*MUTATORS, INSIDE]
    return names[number % len(names)], ways[number // len(names) % len(ways)]


def read_spoilt_files(far: Connection, folder: Path, first: int, files: int, seed: int) -> None:
    """Reads files one after the other and sends a verdict on each."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    for number in range(first, files):
        verdict = read_spoilt(folder / str(os.getpid()), number, seed)
        far.send_bytes(json.dumps(vars(verdict)).encode())
    os._exit(0)


def read_spoilt(folder: Path, number: int, seed: int) -> Verdict:
    """Makes one spoilt file, reads it, and judges what came of it."""
    name, way = case_of(number)
    kind, rng = FORMATS[name], random.Random(f"{seed}/{number}")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = kind.make(folder)
    sound = path.read_bytes()
    if way != INSIDE:
        path.write_bytes(MUTATORS[way](sound, rng))
    elif kind.respoil is not None:
        path = forge(path, kind.respoil(sound, rng))
    else:  # without a container to look into: two blind ways, one after the other
        first, second = rng.sample(list(MUTATORS.values()), 2)
        path.write_bytes(second(first(sound, rng) or sound, rng))

    def verdict(what: str, why: str = "") -> Verdict:
        return Verdict(name, way, number, what, why, peak_memory())

    try:
        value = kind.read(path)
    except AvatarError as error:
        return verdict("refused" if str(folder) in str(error) else "unnamed", str(error)[:300])
    except Exception:
        return verdict("untyped", traceback.format_exc()[-800:])
    fault = kind.judge(value)
    return verdict("unsound", fault) if fault else verdict("sound")
