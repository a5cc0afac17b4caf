"""What became of the jobs of a multirun, wherever they ran: one small file a job, and a summary of them all."""

from __future__ import annotations

import json
import os
import socket
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from avatar.io.npz import write_whole

STOP = "stop"  # a file that says so


class State(Enum):
    """How far a job got; ``running`` is written when it begins, so a job that dies is still at it for ever."""

    running = "running"
    finished = "finished"
    failed = "failed"
    stopped = "stopped"  # by a signal, with everything saved


@dataclass(frozen=True)
class Outcome:
    """One job: ``number`` in the multirun, its command line, how far it got, and why no further.

    ``settings`` are those of a finished job, as plain values.
    """

    number: int
    job: str
    state: str
    why: str = ""
    process: int = 0
    machine: str = ""
    settings: dict[str, Any] = field(default_factory=dict)


def note_outcome(
    folder: Path, number: int, job: str, state: State, why: str = "", settings: dict[str, Any] | None = None
) -> None:
    """Writes down how far a job got; any process on any machine that sees the folder may do so."""
    outcome = Outcome(number, job, state.value, why, os.getpid(), socket.gethostname(), settings or {})
    write_whole(folder / f"job-{number:04d}.json", json.dumps(asdict(outcome), indent=1).encode())


def read_outcomes(folder: Path) -> list[Outcome]:
    """The outcomes in a folder, by job number."""
    return [Outcome(**json.loads(path.read_bytes())) for path in sorted(folder.glob("job-*.json"))]


def ask_to_stop(folder: Path, number: int) -> bool:
    """Sends a signal to the jobs at work in other processes of this machine, and lets no further one begin.

    Returns:
        Whether there were any.
    """
    if not folder.is_dir():
        return False
    (folder / STOP).touch()
    found = False
    for outcome in read_outcomes(folder):
        elsewhere = outcome.process != os.getpid() and outcome.machine == socket.gethostname()
        if outcome.state == State.running.value and elsewhere:
            with suppress(ProcessLookupError):
                os.kill(outcome.process, number)
                found = True
    return found


def is_stopping(folder: Path) -> bool:
    """Whether the multirun was asked to stop."""
    return (folder / STOP).exists()


def summarise(outcomes: list[Outcome]) -> str:
    """A count, then one line for every job that did not finish, with the reason."""
    bad = [outcome for outcome in outcomes if outcome.state != State.finished.value]
    counts = {state: sum(outcome.state == state.value for outcome in outcomes) for state in State}
    words = {State.running: "crashed or still running"}
    parts = [f"{count} {words.get(state, state.value)}" for state, count in counts.items() if count]
    lines = [f"{len(outcomes)} jobs: {', '.join(parts)}."]
    for outcome in bad:
        why = outcome.why or f"process {outcome.process} on {outcome.machine} died, or is still at work"
        lines.append(f"  {outcome.state}: {outcome.job}: {why}")
    if bad:
        lines.append("The same command does what is missing; what is finished is not done again.")
    return "\n".join(lines)
