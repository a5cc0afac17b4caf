"""`fuzz`: thousands of mutated files for every reader; each is either valid or refused with one typed error."""

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
from reliability.formats import FORMATS, replace_content
from reliability.mutations import INSIDE, MUTATORS
from reliability.workers import peak_memory

HANG_S = 10.0
MEMORY = 2 << 30  # bytes that a reader may have resident at most
ADDRESS_SPACE = 16 << 30  # bytes; a reader that wants more is stopped before the machine is


@dataclass(frozen=True)
class ReadResult:
    """Result of reading one file: ``kind`` valid, refused, invalid, untyped, unnamed, crash or hang, and why."""

    format: str
    mutator: str
    number: int
    kind: str
    why: str = ""
    peak: int = 0


def fuzz_trial(root: Path, files: int, seed: int) -> list[Finding]:
    """Mutates valid files of every format by every mutator in turn and reads them in a separate process.

    Results that are neither valid nor refused are written to ``<root>/fuzz.json``, with the number that reproduces
    them.
    """
    shutil.rmtree(root / "fuzz", ignore_errors=True)
    results: list[ReadResult] = []
    while len(results) < files:
        results += read_until_crash(root / "fuzz", len(results), files, seed)
    bad = [vars(result) for result in results if result.kind not in ("valid", "refused")]
    write_whole(root / "fuzz.json", json.dumps(bad, indent=1).encode())
    counts = Counter(result.kind for result in results)
    peak = max(result.peak for result in results)
    return [
        none_of("fuzz", "files that crashed the reader", counts["crash"], files),
        none_of("fuzz", "files that took the reader more than 10 s", counts["hang"], files),
        none_of("fuzz", "invalid and accepted, by an independent validator", counts["invalid"], files),
        none_of("fuzz", "refused with an untyped error", counts["untyped"], files),
        none_of("fuzz", "refused without the file's name", counts["unnamed"], files),
        Finding("fuzz", "refused with file and reason", counts["refused"], f"of {files}", files),
        Finding("fuzz", "read, and valid", counts["valid"], f"of {files}", files),
        Finding("fuzz", "peak resident memory of the reader", round(peak / 2**20), "MiB", files, None, MEMORY / 2**20),
    ]


def read_until_crash(folder: Path, first: int, files: int, seed: int) -> list[ReadResult]:
    """Results of files from ``first`` on, until all are read or the reading process crashes or hangs."""
    near, far = get_context("fork").Pipe()
    process = get_context("fork").Process(
        target=read_mutated_files, args=(far, folder, first, files, seed), daemon=True
    )
    process.start()
    far.close()
    results: list[ReadResult] = []
    while first + len(results) < files:
        kind = ""
        if not near.poll(HANG_S):
            kind = "hang"
        else:
            try:
                results.append(ReadResult(**json.loads(near.recv_bytes())))
            except (EOFError, OSError):
                kind = "crash"
        if kind:
            number = first + len(results)
            process.kill()
            process.join()
            why = f"exit code {process.exitcode}"
            results.append(ReadResult(*case_of(number), number, kind, why))
            break
    process.join(1)
    process.kill()
    near.close()
    return results


def case_of(number: int) -> tuple[str, str]:
    """Format and mutator by a file's number."""
    names, mutators = list(FORMATS), [*MUTATORS, INSIDE]
    return names[number % len(names)], mutators[number // len(names) % len(mutators)]


def read_mutated_files(far: Connection, folder: Path, first: int, files: int, seed: int) -> None:
    """Reads files one after the other and sends a result for each."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    for number in range(first, files):
        result = read_mutated(folder / str(os.getpid()), number, seed)
        far.send_bytes(json.dumps(vars(result)).encode())
    os._exit(0)


def read_mutated(folder: Path, number: int, seed: int) -> ReadResult:
    """Makes one mutated file, reads it, and validates what was read."""
    name, mutator = case_of(number)
    kind, rng = FORMATS[name], random.Random(f"{seed}/{number}")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = kind.make(folder)
    valid = path.read_bytes()
    if mutator != INSIDE:
        path.write_bytes(MUTATORS[mutator](valid, rng))
    elif kind.mutate_values is not None:
        path = replace_content(path, kind.mutate_values(valid, rng))
    else:  # no container whose values could be mutated: two mutators, one after the other
        first, second = rng.sample(list(MUTATORS.values()), 2)
        path.write_bytes(second(first(valid, rng) or valid, rng))

    def result(what: str, why: str = "") -> ReadResult:
        return ReadResult(name, mutator, number, what, why, peak_memory())

    try:
        value = kind.read(path)
    except AvatarError as error:
        return result("refused" if str(folder) in str(error) else "unnamed", str(error)[:300])
    except Exception:
        return result("untyped", traceback.format_exc()[-800:])
    fault = kind.validate(value)
    return result("invalid", fault) if fault else result("valid")
