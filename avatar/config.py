"""Hydra at the border: registers every settings class's defaults, turns composed configs into settings, runs verbs.

Defaults live in the dataclasses alone; here they become plain nodes that `conf/` builds on. Names pick classes from
registries; a config never names code. What a verb does, and torch, is imported once its options are known to be right.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
import traceback
from contextlib import nullcontext
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from avatar.arguments import explain, help_text, refuse_code, text_options, tidy_arguments
from avatar.checks import AvatarError, check_trained
from avatar.cli import collect_garbage, leave_at_once, refuse, silence_closed_streams
from avatar.data.folders import outfit_folder
from avatar.declared import declared, method_settings
from avatar.environment import prepared_process
from avatar.invocation import CONF, PIPE_CLOSED, STOPPED
from avatar.io.documents import read_yaml
from avatar.pipeline import outcomes
from avatar.pipeline.outcomes import State
from avatar.progress import WORK
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.training.signals import Stopped, leave_when_asked, listening
from avatar.verbs import VERBS, Verb, resolve, typed_words
from avatar.world import current_world, torchrun_world

report = logging.getLogger(__name__)


def register(name: str, verb: Verb | None = None) -> None:
    """Stores the defaults of a verb's settings, and of all methods' where it takes one, under ``<name>_defaults``.

    The configuration file of a verb that is not in `VERBS` is stored beside them, for Hydra searches ``conf/`` alone.
    """
    verb = verb or VERBS[name]
    store, defaults = ConfigStore.instance(), settings_to_dict(declared(verb.settings)())
    store.store(name=f"{name}_defaults", node=defaults)
    for method, kind in method_settings().items() if isinstance(defaults.get("method"), dict) else ():
        options = settings_to_dict(declared(kind)())
        store.store(group="method", name=f"{method}_defaults", node={"settings": options})
        if not (CONF / "method" / f"{method}.yaml").is_file():  # a method that fixes nothing needs no file there
            node = {"name": method, "variant": method, "settings": options}
            node = {"defaults": [{"/size": "small"}, "_self_"], "method": node}
            store.store(group="method", name=method, node=node, package="_global_")
    if verb.conf:
        store.store(name=name, node=read_yaml(verb.conf))


def to_settings(kind: type, config: DictConfig) -> Any:
    """A composed config as its settings class."""
    return settings_from_dict(kind, OmegaConf.to_container(config, resolve=True, throw_on_missing=True))


def compose_settings(name: str, *options: str, verb: Verb | None = None) -> Any:
    """A verb's settings as the command line would give them with these options; within a verb's run as well.

    Raises `AvatarError` for unknown options, and values out of range or of another type.
    """
    verb = verb or VERBS[name]
    register(name, verb)
    words = tidy_arguments(list(options), text_options(declared(verb.settings)))
    running = GlobalHydra.instance().is_initialized()
    try:
        with nullcontext() if running else hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return to_settings(resolve(verb.settings), hydra.compose(name, words))
    except (HydraException, OmegaConfBaseException) as error:
        raise AvatarError(explain(error, name, words)) from error


def command(name: str, verb: Verb | None = None) -> None:
    """Runs a verb from the command line: composes its config, converts it, calls its function with the settings.

    Bad input ends in one line on standard error and exit code 2, not in a traceback; a signal that asks to stop in
    exit code 75 once all is saved. In a multirun, by whatever launcher, the other jobs go on after a failure; those
    that did not finish are named with the reason at the end, and the exit code is 2. After that the verb's ``then``
    is called with the settings of the jobs that did finish, if any, unless the multirun was asked to stop. ``verb`` is
    given where it is not in `VERBS`.
    """
    verb = verb or VERBS[name]
    journal = Path("runs/multirun").absolute() / f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{os.getpid()}"
    os.environ["AVATAR_MULTIRUN"] = str(journal)  # conf/hydra/quiet.yaml: the launchers' own files go there as well
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra passes errors on, instead of printing them its way
    parent = os.getpid()

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)
    def main(config: DictConfig) -> None:
        run_job(name, verb, config, journal, parent)

    code = 0
    with torchrun_world() as world, leave_when_asked(lambda number: outcomes.ask_to_stop(journal, number)):
        listen_to_verbs(logging.INFO if world.is_main else logging.WARNING)
        try:
            register(name, verb)
            sys.argv[1:] = tidy_arguments(sys.argv[1:], text_options(declared(verb.settings)), bool(verb.then))
            refuse_code(sys.argv[1:])
            if {"--help", "-h"} & set(sys.argv):
                print(help_text(name, verb, [word for word in sys.argv[1:] if word[0] != "-"]))
            else:
                main()
        except SystemExit as leaving:
            code = leaving.code
        except (HydraException, OmegaConfBaseException) as error:
            code = refuse(name, explain(error, name, sys.argv[1:]))
        except AvatarError as error:
            code = refuse(name, error)
        jobs = outcomes.read_outcomes(journal)
        if jobs and code != PIPE_CLOSED:
            code = conclude(name, verb, jobs) or code
    sys.exit(code)


def conclude(name: str, verb: Verb, jobs: list[outcomes.Outcome]) -> int:
    """Says what became of a multirun's jobs and calls the verb's ``then`` for those that finished; the exit code."""
    print(outcomes.summarise(jobs), file=sys.stderr)
    states = {State(job.state) for job in jobs} - {State.finished}
    if State.stopped in states:
        return STOPPED
    code = 2 if states else 0
    finished = [job.settings for job in jobs if job.state == State.finished]
    if verb.then and finished:
        done = [settings_from_dict(resolve(verb.settings), settings) for settings in finished]
        collect_garbage()  # where workers did the jobs
        try:
            report.info("%s: %s", name, resolve(verb.then)(done))
        except AvatarError as error:
            code = refuse(name, error)
    return code


def run_job(name: str, verb: Verb, config: DictConfig, journal: Path, parent: int) -> None:
    """One job of a verb, in the ``parent`` process or in one that a launcher started.

    In a multirun its outcome is noted in ``journal`` and a failure is no reason to leave; else ``then`` follows.
    """
    listen_to_verbs(logging.INFO)
    job = HydraConfig.get()
    several = job.mode is RunMode.MULTIRUN
    line = " ".join([*typed_words(name), *OmegaConf.to_container(job.overrides.task, resolve=False)])

    def note(state: State, **facts: Any) -> None:
        if several:
            outcomes.note_outcome(journal, job.job.num, line, state, **facts)

    def end(state: State, why: str, code: int) -> None:
        print(f"{line}: {why}", file=sys.stderr)
        note(state, why=why)
        if not several or (state is State.stopped and os.getpid() == parent):
            sys.exit(code)

    if several and (journal / outcomes.STOP).exists():
        return end(State.stopped, "not begun.", STOPPED)
    if several and current_world().size > 1:
        return end(State.failed, "torchrun trains one run; leave out either it or --multirun.", 2)
    note(State.running)
    try:
        refuse_missing(to_settings(declared(verb.settings), config))
        leaving = (signal.SIGINT, signal.SIGTERM) if os.getpid() == parent else ()
        with listening(leave_at_once(name), leaving):
            settings, run = to_settings(resolve(verb.settings), config), resolve(verb.run)
        collect_garbage()
        with leave_when_asked(), prepared_process():
            WORK.clear()
            started = time.monotonic()
            result = run(settings)
            outcomes.report_ending(name, settings, result, time.monotonic() - started)
            if verb.then and not several and current_world().is_main:
                report.info("%s: %s", name, resolve(verb.then)([settings]))
    except Stopped as stopped:
        return end(State.stopped, str(stopped), STOPPED)
    except SystemExit as leaving:
        if leaving.code != STOPPED:
            raise
        return end(State.stopped, "stopped by a signal. The same command goes on with what is missing.", STOPPED)
    except AvatarError as error:
        return end(State.failed, str(error), 2)
    except OmegaConfBaseException as error:
        return end(State.failed, explain(error, name, sys.argv[1:]), 2)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and silence_closed_streams():
            sys.exit(PIPE_CLOSED)
        if not several:
            raise
        traceback.print_exc()
        return end(State.failed, f"{type(error).__name__}: {error}", 1)
    return note(State.finished, settings=settings_to_dict(settings))


def refuse_missing(settings: Any) -> None:
    """Raises `DataError` for a run or an outfit that settings name and that is not there: before a verb is imported."""
    if isinstance(run := getattr(settings, "run", None), Path):
        check_trained(run / "avatar")
    outfits = getattr(settings, "outfit", ()) if getattr(settings, "predictions", "own") else ()  # of a foreign program
    for outfit in (outfits,) if isinstance(outfits, str) else outfits:
        outfit_folder(settings.data_root or Path("data"), settings.dataset, outfit)


class Lines(logging.StreamHandler):
    """What verbs report, a line each on standard error; a reader that leaves asks to stop, as a signal does."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Asks to stop where the reader has left; reports other failures as logging does."""
        if isinstance(sys.exc_info()[1], BrokenPipeError) and silence_closed_streams():
            signal.raise_signal(signal.SIGTERM)
        else:
            super().handleError(record)


def listen_to_verbs(level: int) -> None:
    """Prints what verbs report, from a level on; conf/hydra keeps Hydra quiet."""
    logging.basicConfig(level=level, format="%(message)s", handlers=[Lines()])
