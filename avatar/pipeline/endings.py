"""What a verb says when it is done: what it made and where, how long it took, and the command that may follow."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from avatar.invocation import activation_line, command_line, interpreter, shorten
from avatar.progress import WORK, in_words
from avatar.values import option

RESUMED = ("simulate", "canonicalize", "train", "predict", "evaluate", "mesh", "experiment")  # skip what is finished
SPLITS = ("train", "test", "interpolation", "validation")
report = logging.getLogger(__name__)
Ending = tuple[list[Path], list[str]]  # what was made, and commands that may follow


def data_root(folder: Path) -> list[str]:
    """The option that names a data root, where it is not the usual one."""
    return [] if folder == Path("data") else [option("data_root", folder)]


def after_simulate(config: Any, reports: list[Any]) -> Ending:
    """The outfits' folders; training on the first one follows."""
    from avatar.simulate.recording import dressed_outfits

    root, names = config.root, [name for name, _ in dressed_outfits(config)]
    where = [f"dataset={root.name}", f"outfit={names[0]}", *data_root(root.parent)]
    return ([], []) if config.history else ([root / name for name in names], [command_line("train", *where)])


def after_canonicalize(config: Any, folder: Path) -> Ending:
    """The canonical scans; the method that takes them follows."""
    where = [f"dataset={config.dataset}", f"outfit={config.outfit}", f"canonical={config.name}"]
    made = [folder / "scans", folder / "pictures", *([folder / "scores.md"] if config.scored else [])]
    return made, [command_line("train", "method=scanimate", *where, *data_root(config.data_root))]


def after_training(config: Any, folder: Path) -> Ending:
    """The weights; predictions follow."""
    return [folder / "avatar.safetensors"], [command_line("predict", option("run", folder))]


def after_predict(config: Any, folders: list[Path]) -> Ending:
    """The folders of point clouds; scores of a split follow, or meshes of a motion."""
    name = folders[0].parent.name
    if config.motion is not None:
        return folders, [command_line("mesh", option("run", config.run), f"predictions={name}")]
    split = [] if name == "test" else [f"split={name}"]
    return folders, [command_line("evaluate", option("runs", [config.run]), *split)]


def after_evaluate(config: Any, scores: Any) -> Ending:
    """The tables of scores; the run's page follows."""
    from avatar.pipeline.scores import scores_file

    if config.predictions is not None:
        return [(config.out or config.predictions) / "scores.csv"], []
    made = [scores_file(run, config.split) for run in config.runs]
    return made, [command_line("report", option("run", config.runs[-1]))]


def after_mesh(config: Any, reports: dict[Path, Any]) -> Ending:
    """The folders of meshes; the run's page follows, or a motion's animation files."""
    if config.predictions in SPLITS:
        return list(reports), [command_line("report", option("run", config.run))]
    return list(reports), [command_line("export", option("run", config.run), f"predictions={config.predictions}")]


def after_demo(config: Any, summary: Path) -> Ending:
    """All that the main job made; a longer training follows, in the environment that it ran in."""
    made = json.loads(summary.read_text())["made"].values()
    paths = [Path(path) for listed in made for path in ([listed] if isinstance(listed, str) else listed)]
    activation = activation_line() if interpreter() != "python" else ""
    following = command_line("train", f"outfit={config.outfit[0]}", "train.minutes=30")
    return [*paths, summary], [*filter(None, [activation]), following]


def after_others(config: Any, made: Path | list[Path]) -> Ending:
    """What other verbs made."""
    return made if isinstance(made, list) else [made], []


ENDINGS: dict[str, Callable[[Any, Any], Ending]] = {
    "simulate": after_simulate,
    "canonicalize": after_canonicalize,
    "train": after_training,
    "fit": after_training,
    "predict": after_predict,
    "evaluate": after_evaluate,
    "mesh": after_mesh,
    "demo": after_demo,
}


def report_ending(verb: str, config: Any, result: Any, seconds: float) -> None:
    """Logs how a verb ended: what it made, and the commands that may follow, ready for the shell."""
    made, following = ENDINGS.get(verb, after_others)(config, result)
    if verb in RESUMED and not WORK["step"] and not WORK["made"]:
        report.info("%s: finished already, nothing was left to do.", verb)
    else:
        counts = {"steps": WORK["step"], "made": WORK["made"], "finished before": WORK["found"]}
        details = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        report.info("%s: done in %s%s.", verb, in_words(seconds), f" ({details})" if details else "")
    for path in dict.fromkeys(made):
        report.info("  %s", shorten(path))
    for line in following:
        report.info("next: %s", line)
