"""How verbs end: what one made and the command that may follow, and what became of the jobs of a multirun."""

from __future__ import annotations

import json
import logging
import os
import socket
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from avatar.invocation import activation_line, command_line, interpreter, option, shorten
from avatar.io.npz import write_whole
from avatar.progress import WORK, in_words
from avatar.verbs import typed_words

RESUMED = ("simulate", "canonicalize", "template", "train", "predict", "evaluate", "texture", "mesh", "experiment")
RESUMED += ("data_convert", "data_fit")
SPLITS = ("train", "test", "interpolation", "validation")
STOP = "stop"  # a file in the folder of a multirun that was asked to stop
report = logging.getLogger(__name__)


def find_ending(verb: str, config: Any, result: Any) -> tuple[list[Path], list[str]]:
    """What a verb made, from its settings and what it returned, and commands that may follow."""

    def split_of(name: str) -> list[str]:
        return [] if name == "test" else [f"split={name}"]

    def data_root(folder: Path) -> list[str]:
        return [] if folder == Path("data") else [option("data_root", folder)]

    match verb:
        case "simulate":
            from avatar.simulate.recording import dressed_outfits

            if config.history or config.distances:
                return [], []
            root, names = config.root, [name for name, _ in dressed_outfits(config)]
            where = [f"dataset={root.name}", f"outfit={names[0]}", *data_root(root.parent)]
            return [root / name for name in names], [command_line("train", *where)]
        case "data_convert" | "data_fit":
            where = [f"dataset={config.dataset}", f"outfit={result[0].name}", *data_root(config.data_root)]
            return result, [command_line("train", *where)]
        case "canonicalize":
            where = [f"dataset={config.dataset}", f"outfit={config.outfit}", f"canonical={config.name}"]
            made = [result / "scans", result / "pictures", *([result / "scores.md"] if config.scored else [])]
            where += data_root(config.data_root)
            if config.runs_root != Path("runs"):
                where.append(option("runs_root", config.runs_root))
            return made, [command_line(*words, *where) for words in (("train", "method=scanimate"), ("template",))]
        case "template":
            return [result / name for name in ("template.npz", "template.ply", "pictures", "report.json")], []
        case "train" | "fit":
            return [result / "avatar.safetensors"], [command_line("predict", option("run", result))]
        case "predict":
            name = result[0].parent.name
            if config.motion is not None:
                return result, [command_line("mesh", option("run", config.run), f"predictions={name}")]
            return result, [command_line("evaluate", option("runs", [config.run]), *split_of(name))]
        case "evaluate":
            from avatar.pipeline.scores import scores_file

            if config.predictions is not None:
                return [(config.out or config.predictions) / "scores.csv"], []
            made = [scores_file(run, config.split) for run in config.runs]
            return made, [command_line("report", option("run", config.runs[-1]), *split_of(config.split))]
        case "texture":
            made = [result / name for name in ("texture.png", "texture.npz", "template.glb", "report.json")]
            made += [result / "pictures"] if config.pictures and config.scored else []
            return made, [command_line("mesh", option("run", config.run))]
        case "mesh":
            run = option("run", config.run)
            if config.predictions in SPLITS:
                return list(result), [command_line("report", run, *split_of(config.predictions))]
            return list(result), [command_line("export", run, f"predictions={config.predictions}")]
        case "demo":
            made = json.loads(result.read_text())["made"].values()
            paths = [Path(path) for listed in made for path in ([listed] if isinstance(listed, str) else listed)]
            activation = [activation_line()] if interpreter() != "python" else []
            what = [f"method={config.method.variant}", f"dataset={config.dataset}", f"outfit={config.outfit[0]}"]
            longer = command_line("train", *what, *data_root(config.data_root), "train.minutes=30")
            return [*paths, result], [*filter(None, activation), longer]
    return result if isinstance(result, list) else [result], []


def report_ending(verb: str, config: Any, result: Any, seconds: float) -> None:
    """Logs how a verb ended: what it made, and the commands that may follow, ready for the shell."""
    made, following = find_ending(verb, config, result)
    words = " ".join(typed_words(verb))
    if verb in RESUMED and made and not WORK["step"] and not WORK["made"]:
        report.info("%s: finished already, nothing was left to do.", words)
    else:
        counts = {"steps": WORK["step"], "made": WORK["made"], "finished before": WORK["found"]}
        details = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        report.info("%s: done in %s%s.", words, in_words(seconds), f" ({details})" if details else "")
    for path in dict.fromkeys(made):
        report.info("  %s", shorten(path))
    for line in following:
        report.info("next: %s", line)


class State(StrEnum):
    """How far a job got; ``running`` is written when it begins, so a job that dies is still at it for ever."""

    running = "running"
    finished = "finished"
    failed = "failed"
    stopped = "stopped"  # by a signal, with everything saved


@dataclass(frozen=True)
class Outcome:
    """One job: ``number`` in the multirun, its command line, how far it got, and why no further. ``settings`` are those
    of a finished job, as plain values.
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
    outcome = Outcome(number, job, state, why, os.getpid(), socket.gethostname(), settings or {})
    write_whole(folder / f"job-{number:04d}.json", json.dumps(asdict(outcome), indent=1).encode())


def read_outcomes(folder: Path) -> list[Outcome]:
    """The outcomes in a folder, by job number."""
    return [Outcome(**json.loads(path.read_bytes())) for path in sorted(folder.glob("job-*.json"))]


def ask_to_stop(folder: Path, number: int) -> bool:
    """Sends a signal to the jobs at work in other processes of this machine, if any, and lets no further one begin."""
    if not folder.is_dir():
        return False
    (folder / STOP).touch()
    found, here = False, socket.gethostname()
    for outcome in read_outcomes(folder):
        if outcome.state == State.running and outcome.process != os.getpid() and outcome.machine == here:
            with suppress(ProcessLookupError):
                os.kill(outcome.process, number)
                found = True
    return found


def summarise(outcomes: list[Outcome]) -> str:
    """A count, then one line for every job that did not finish, with the reason."""
    counts = {state: sum(outcome.state == state for outcome in outcomes) for state in State}
    words = {State.running: "crashed or still running"}
    parts = [f"{count} {words.get(state, state)}" for state, count in counts.items() if count]
    lines = [f"{len(outcomes)} jobs: {', '.join(parts)}."]
    for outcome in outcomes:
        if outcome.state != State.finished:
            why = outcome.why or f"process {outcome.process} on {outcome.machine} died, or is still at work"
            lines.append(f"  {outcome.state}: {outcome.job}: {why}")
    if len(lines) > 1:
        lines.append("The same command does what is missing; what is finished is not done again.")
    return "\n".join(lines)
