"""Hydra at the border: registers every settings class's defaults, and turns a composed config into settings.

Defaults live in the dataclasses alone. Here they become plain nodes that `conf/` builds on, so a misspelt option on
the command line is refused by Hydra, and one in a file by `settings_from_dict`. Names pick classes from registries;
a config never names code.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import sys
import traceback
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from avatar.checks import AvatarError, DataError
from avatar.environment import prepared_process
from avatar.io.documents import check_events, read_yaml
from avatar.pipeline.benchmarks.bench import BenchConfig
from avatar.pipeline.comparison import CompareConfig
from avatar.pipeline.demo import DemoConfig
from avatar.pipeline.experiments import ExperimentConfig
from avatar.pipeline.methods import SETTINGS
from avatar.pipeline.outcomes import State, ask_to_stop, is_stopping, note_outcome, read_outcomes, summarise
from avatar.pipeline.reporting import ReportConfig
from avatar.pipeline.scores import EvaluateConfig, PredictConfig
from avatar.pipeline.seams import SeamsConfig
from avatar.pipeline.surfaces import ExportConfig, MeshConfig
from avatar.pipeline.torture.trials import TortureConfig
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.simulate.recording import SimulateConfig
from avatar.training.canonicalizing import CanonicalizeConfig
from avatar.training.distributed import current_team, torchrun_team
from avatar.training.fitting import FitConfig
from avatar.training.runs import RunConfig
from avatar.training.signals import STOPPED, Stopped, leave_when_asked

CONF = Path(__file__).parents[1] / "conf"
VERBS = {
    "canonicalize": CanonicalizeConfig,
    "train": RunConfig,
    "fit": FitConfig,
    "predict": PredictConfig,
    "evaluate": EvaluateConfig,
    "compare": CompareConfig,
    "experiment": ExperimentConfig,
    "mesh": MeshConfig,
    "export": ExportConfig,
    "report": ReportConfig,
    "seams": SeamsConfig,
    "demo": DemoConfig,
    "simulate": SimulateConfig,
    "torture": TortureConfig,
    "bench": BenchConfig,
}
Settings = TypeVar("Settings")


def register() -> None:
    """Stores the defaults of every verb's and every method's settings under ``<name>_defaults``."""
    store = ConfigStore.instance()
    for verb, kind in VERBS.items():
        store.store(name=f"{verb}_defaults", node=settings_to_dict(kind()))
    for name, kind in SETTINGS.items():
        store.store(group="method", name=f"{name}_defaults", node={"settings": settings_to_dict(kind())})


def to_settings(kind: type[Settings], config: DictConfig) -> Settings:
    """A composed config as its settings class."""
    plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return settings_from_dict(kind, plain)


def compose_settings(verb: str, *overrides: str) -> Any:
    """A verb's settings as the command line would give them with these overrides."""
    register()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return to_settings(VERBS[verb], hydra.compose(verb, list(overrides)))


def refuse_code(arguments: list[str]) -> None:
    """Refuses command lines by which a file could become code; what is typed on them is trusted, files are not.

    Hydra makes objects of what its own options name (callbacks, launchers, log handlers). A folder of configuration
    from elsewhere (``--config-dir``) may therefore set options of verbs and nothing of Hydra's, nor read the
    environment, and the two options by which Hydra looks in further places are not taken.

    Raises:
        AvatarError: naming the option.
        DataError: naming the file and the word in it.
    """
    for argument in arguments:
        if argument.lstrip("+~").startswith("hydra.searchpath") or argument.startswith("--experimental-rerun"):
            raise AvatarError(f"{argument.partition('=')[0]}: not taken here; use --config-dir with a folder of YAML.")
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    for names in (("--config-dir", "-cd"), ("--config-path", "-cp")):
        parser.add_argument(*names, dest="folders", action="append", default=[], type=Path)
    for folder in parser.parse_known_args(arguments)[0].folders:
        for path in sorted(folder.rglob("*.y*ml")):
            refuse_machinery(path, path.relative_to(folder))


def refuse_machinery(path: Path, name: Path) -> None:
    """Refuses a configuration file that speaks of Hydra's own options, of objects, or of the environment.

    Raises:
        DataError: naming the file and the word in it.
    """
    read_yaml(path)
    text = path.read_text(encoding="utf-8")
    headers = [line for line in text.splitlines() if "@package" in line]
    for word in (*check_events(path, text), *headers, str(name)):
        if any(sign in word for sign in ("hydra", "_target_", "()")) or re.search(r"\$\{[^}]*:", word):
            mend = "Options of verbs are all that a configuration from elsewhere may set."
            raise DataError(path, f"{word!r:.100} could run code or read the environment: not read.", mend)


def command(verb: str, run: Callable[[Any], Any], then: Callable[[list[Any]], Any] | None = None) -> None:
    """Runs a verb from the command line: composes its config, converts it, calls ``run`` with the settings.

    Bad input ends in one line on standard error and exit code 2, not in a traceback; a signal that asks to stop in
    exit code 75 once all is saved. In a multirun, by whatever launcher, the other jobs go on after a failure; those
    that did not finish are named with the reason at the end, and the exit code is 2. After that ``then`` is called
    with the settings of the jobs that did finish, if any, unless the multirun was asked to stop.
    """
    register()
    journal = Path("runs/multirun").absolute() / f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{os.getpid()}"
    os.environ["AVATAR_MULTIRUN"] = str(journal)  # conf/hydra/quiet.yaml: the launchers' own files go there as well
    parent = os.getpid()

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=verb)
    def main(config: DictConfig) -> None:
        run_job(verb, run, config, journal, parent, then)

    with torchrun_team() as team, leave_when_asked(lambda number: ask_to_stop(journal, number)):
        logging.basicConfig(level=logging.INFO if team.leads else logging.WARNING, format="%(message)s")
        code = 0
        try:
            refuse_code(sys.argv[1:])
            main()
        except SystemExit as leaving:
            code = leaving.code
        except AvatarError as error:
            print(f"{verb}: {error}", file=sys.stderr)
            code = 2
    outcomes = read_outcomes(journal)
    if outcomes:
        print(summarise(outcomes), file=sys.stderr)
    states = {State(outcome.state) for outcome in outcomes} - {State.finished}
    finished = [outcome.settings for outcome in outcomes if outcome.state == State.finished.value]
    if then is not None and finished and State.stopped not in states:
        try:
            then([settings_from_dict(VERBS[verb], settings) for settings in finished])
        except AvatarError as error:
            print(f"{verb}: {error}", file=sys.stderr)
            code = code or 2
    sys.exit(STOPPED if State.stopped in states else code or (2 if states else 0))


@prepared_process()
def run_job(
    verb: str,
    run: Callable[[Any], Any],
    config: DictConfig,
    journal: Path,
    parent: int,
    then: Callable[[list[Any]], Any] | None = None,
) -> None:
    """One job of a verb, in the ``parent`` process or in one that a launcher started.

    In a multirun its outcome is noted in ``journal``, and a failure is no reason to leave. ``then`` follows a job
    that is the only one.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")  # what verbs report; conf/hydra keeps Hydra quiet
    job = HydraConfig.get()
    several = job.mode is RunMode.MULTIRUN
    name = " ".join([verb, *job.overrides.task])

    def end(state: State, why: str, code: int) -> None:
        print(f"{name}: {why}", file=sys.stderr)
        if several:
            note_outcome(journal, job.job.num, name, state, why)
        if not several or (state is State.stopped and os.getpid() == parent):
            sys.exit(code)

    if several and is_stopping(journal):
        return end(State.stopped, "not begun.", STOPPED)
    if several and current_team().size > 1:
        return end(State.failed, "torchrun trains one run; leave out either it or --multirun.", 2)
    if several:
        note_outcome(journal, job.job.num, name, State.running)
    try:
        settings = to_settings(VERBS[verb], config)
        with leave_when_asked():
            run(settings)
            if then is not None and not several and current_team().leads:
                then([settings])
    except Stopped as stopped:
        return end(State.stopped, str(stopped), STOPPED)
    except SystemExit as leaving:
        if leaving.code != STOPPED:
            raise
        return end(State.stopped, "stopped by a signal. The same command goes on with what is missing.", STOPPED)
    except AvatarError as error:
        return end(State.failed, str(error), 2)
    except Exception as error:
        if not several:
            raise
        traceback.print_exc()
        return end(State.failed, f"{type(error).__name__}: {error}", 1)
    if several:
        note_outcome(journal, job.job.num, name, State.finished, settings=settings_to_dict(settings))
    return None
