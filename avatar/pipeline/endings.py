"""What a verb says when it is done: what it made and where, how long it took, and the command that may follow."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from avatar.invocation import activation_line, command_line, interpreter, option, shorten
from avatar.progress import WORK, in_words

RESUMED = ("simulate", "canonicalize", "train", "predict", "evaluate", "mesh", "experiment")  # skip what is finished
SPLITS = ("train", "test", "interpolation", "validation")
report = logging.getLogger(__name__)


def find_ending(verb: str, config: Any, result: Any) -> tuple[list[Path], list[str]]:
    """What a verb made, from its settings and what it returned, and commands that may follow."""
    match verb:
        case "simulate":
            from avatar.simulate.recording import dressed_outfits

            if config.history or config.distances:
                return [], []
            root, names = config.root, [name for name, _ in dressed_outfits(config)]
            where = [f"dataset={root.name}", f"outfit={names[0]}", *_data_root(root.parent)]
            return [root / name for name in names], [command_line("train", *where)]
        case "canonicalize":
            where = [f"dataset={config.dataset}", f"outfit={config.outfit}", f"canonical={config.name}"]
            made = [result / "scans", result / "pictures", *([result / "scores.md"] if config.scored else [])]
            return made, [command_line("train", "method=scanimate", *where, *_data_root(config.data_root))]
        case "train" | "fit":
            return [result / "avatar.safetensors"], [command_line("predict", option("run", result))]
        case "predict":
            name = result[0].parent.name
            if config.motion is not None:
                return result, [command_line("mesh", option("run", config.run), f"predictions={name}")]
            split = [] if name == "test" else [f"split={name}"]
            return result, [command_line("evaluate", option("runs", [config.run]), *split)]
        case "evaluate":
            from avatar.pipeline.scores import scores_file

            if config.predictions is not None:
                return [(config.out or config.predictions) / "scores.csv"], []
            made = [scores_file(run, config.split) for run in config.runs]
            return made, [command_line("report", option("run", config.runs[-1]))]
        case "mesh":
            run = option("run", config.run)
            if config.predictions in SPLITS:
                return list(result), [command_line("report", run)]
            return list(result), [command_line("export", run, f"predictions={config.predictions}")]
        case "demo":
            made = json.loads(result.read_text())["made"].values()
            paths = [Path(path) for listed in made for path in ([listed] if isinstance(listed, str) else listed)]
            activation = [activation_line()] if interpreter() != "python" else []
            longer = command_line("train", f"outfit={config.outfit[0]}", "train.minutes=30")
            return [*paths, result], [*filter(None, activation), longer]
    return result if isinstance(result, list) else [result], []


def _data_root(folder: Path) -> list[str]:
    """The option that names a data root, where it is not the usual one."""
    return [] if folder == Path("data") else [option("data_root", folder)]


def report_ending(verb: str, config: Any, result: Any, seconds: float) -> None:
    """Logs how a verb ended: what it made, and the commands that may follow, ready for the shell."""
    made, following = find_ending(verb, config, result)
    if verb in RESUMED and made and not WORK["step"] and not WORK["made"]:
        report.info("%s: finished already, nothing was left to do.", verb)
    else:
        counts = {"steps": WORK["step"], "made": WORK["made"], "finished before": WORK["found"]}
        details = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        report.info("%s: done in %s%s.", verb, in_words(seconds), f" ({details})" if details else "")
    for path in dict.fromkeys(made):
        report.info("  %s", shorten(path))
    for line in following:
        report.info("next: %s", line)
