"""Hydra at the border: registers every settings class's defaults, and turns a composed config into settings.

Defaults live in the dataclasses alone. Here they become plain nodes that `conf/` builds on, so a misspelt option on
the command line is refused by Hydra, and one in a file by `settings_from_dict`. Names pick classes from registries;
a config never names code.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from avatar.checks import AvatarError
from avatar.nn.methods import METHODS
from avatar.pipeline.comparison import CompareConfig
from avatar.pipeline.demo import DemoConfig
from avatar.pipeline.reporting import ReportConfig
from avatar.pipeline.scores import EvaluateConfig, PredictConfig
from avatar.pipeline.surfaces import ExportConfig, MeshConfig
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.simulate.recording import SimulateConfig
from avatar.training.fitting import FitConfig
from avatar.training.runs import RunConfig

CONF = Path(__file__).parents[1] / "conf"
VERBS = {
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
}
Settings = TypeVar("Settings")


def register() -> None:
    """Stores the defaults of every verb's and every method's settings under ``<name>_defaults``."""
    store = ConfigStore.instance()
    for verb, kind in VERBS.items():
        store.store(name=f"{verb}_defaults", node=settings_to_dict(kind()))
    for name, method in METHODS.items():
        store.store(group="method", name=f"{name}_defaults", node={"settings": settings_to_dict(method.settings())})


def to_settings(kind: type[Settings], config: DictConfig) -> Settings:
    """A composed config as its settings class."""
    plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return settings_from_dict(kind, plain)


def command(verb: str, run: Callable[[Any], Any]) -> None:
    """Runs a verb from the command line: composes its config, converts it, calls ``run`` with the settings.

    Bad input ends in one line on standard error and exit code 2, not in a traceback; in a multirun the other jobs
    go on, and the failed ones are named again at the end.
    """
    register()
    logging.basicConfig(level=logging.INFO, format="%(message)s")  # what verbs report; conf/hydra keeps Hydra quiet
    failures: list[str] = []

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=verb)
    def main(config: DictConfig) -> None:
        try:
            run(to_settings(VERBS[verb], config))
        except AvatarError as error:
            job = " ".join(HydraConfig.get().overrides.task)
            failures.append(f"{verb} {job}: {error}")
            print(failures[-1], file=sys.stderr)

    main()
    if failures:
        if len(sys.argv) > 1 and {"-m", "--multirun"} & set(sys.argv):
            print(f"{len(failures)} failed:\n" + "\n".join(failures), file=sys.stderr)
        sys.exit(2)
