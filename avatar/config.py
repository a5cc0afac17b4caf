"""Hydra at the border: registers every settings class's defaults, and turns a composed config into settings.

Defaults live in the dataclasses alone. Here they become plain nodes that `conf/` builds on, so a misspelt option on
the command line is refused by Hydra, and one in a file by `settings_from_dict`. Names pick classes from registries;
a config never names code.
"""

from __future__ import annotations

import logging
import os
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

import avatar.environment  # noqa: F401  first of all: it says how threads wait, which torch reads when it is imported
from avatar.checks import AvatarError
from avatar.pipeline.benchmarks.bench import BenchConfig
from avatar.pipeline.comparison import CompareConfig
from avatar.pipeline.demo import DemoConfig
from avatar.pipeline.methods import SETTINGS
from avatar.pipeline.outcomes import State, ask_to_stop, is_stopping, note_outcome, read_outcomes, summarise
from avatar.pipeline.reporting import ReportConfig
from avatar.pipeline.scores import EvaluateConfig, PredictConfig
from avatar.pipeline.surfaces import ExportConfig, MeshConfig
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
    "mesh": MeshConfig,
    "export": ExportConfig,
    "report": ReportConfig,
    "demo": DemoConfig,
    "simulate": SimulateConfig,
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


def command(verb: str, run: Callable[[Any], Any]) -> None:
    """Runs a verb from the command line: composes its config, converts it, calls ``run`` with the settings.

    Bad input ends in one line on standard error and exit code 2, not in a traceback; a signal that asks to stop in
    exit code 75 once all is saved. In a multirun, by whatever launcher, the other jobs go on after a failure; those
    that did not finish are named with the reason at the end, and the exit code is 2.
    """
    register()
    journal = Path("runs/multirun").absolute() / f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{os.getpid()}"
    os.environ["AVATAR_MULTIRUN"] = str(journal)  # conf/hydra/quiet.yaml: the launchers' own files go there as well
    parent = os.getpid()

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=verb)
    def main(config: DictConfig) -> None:
        run_job(verb, run, config, journal, parent)

    with torchrun_team() as team, leave_when_asked(lambda number: ask_to_stop(journal, number)):
        logging.basicConfig(level=logging.INFO if team.leads else logging.WARNING, format="%(message)s")
        code = 0
        try:
            main()
        except SystemExit as leaving:
            code = leaving.code
    outcomes = read_outcomes(journal)
    if outcomes:
        print(summarise(outcomes), file=sys.stderr)
    states = {State(outcome.state) for outcome in outcomes} - {State.finished}
    sys.exit(STOPPED if State.stopped in states else code or (2 if states else 0))


def run_job(verb: str, run: Callable[[Any], Any], config: DictConfig, journal: Path, parent: int) -> None:
    """One job of a verb, in the ``parent`` process or in one that a launcher started.

    In a multirun its outcome is noted in ``journal``, and a failure is no reason to leave.
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
        with leave_when_asked():
            run(to_settings(VERBS[verb], config))
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
        note_outcome(journal, job.job.num, name, State.finished)
    return None
