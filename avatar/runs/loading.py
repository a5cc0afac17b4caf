"""Trained avatars from their runs' folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from avatar.body.packed import read_template
from avatar.checks import AvatarError, DataError
from avatar.environment import choose_device
from avatar.io.checkpoints import building, load_checkpoint, read_weights
from avatar.methods.base import TrainedAvatar
from avatar.methods.registry import find_method
from avatar.methods.settings import RunConfig
from avatar.runs.training import WEIGHTS
from avatar.settings import settings_from_dict


def load_avatar(folder: Path, checkpoint: str = "last", device: str = "auto") -> TrainedAvatar:
    """The trained avatar of a run's folder, of any method.

    Args:
        folder: the run's folder.
        checkpoint: ``last`` (the shared weights) or ``best`` on the held-back frames.
        device: where to put it.

    Raises:
        DataError: when the folder is no finished run, or a file in it is damaged.
    """
    if checkpoint not in ("last", "best"):
        raise AvatarError(f"checkpoint: expected last or best, got {checkpoint!r}.")
    weights, facts = read_weights(folder / WEIGHTS, ("config", "steps", "seconds"))
    with building(folder, weights):
        config = settings_from_dict(RunConfig, facts["config"], f"{folder / WEIGHTS}.json: ")
        method = find_method(config.method.name)
        settings = settings_from_dict(method.Settings, config.method.settings, "method.settings.")
        weights, steps, seconds = choose_weights(folder, checkpoint, weights, facts)
        template = read_template(folder / "template.npz")
        model = method.rebuild(settings, template, len(config.outfit), facts, weights)
        model.load_state_dict(weights)
    return TrainedAvatar(method, settings, model.to(choose_device(device)).eval(), template, config, steps, seconds)


def choose_weights(
    folder: Path, checkpoint: str, last: dict[str, Tensor], facts: dict[str, Any]
) -> tuple[dict[str, Tensor], int, float]:
    """Weights, steps and seconds of a run: the ``last``, which are given, or those of its ``best`` checkpoint.

    Raises:
        DataError: for the best of a run that held no frames back.
    """
    if checkpoint == "last":
        return last, int(facts["steps"]), float(facts["seconds"])
    state = load_checkpoint(folder / "checkpoints", "best")
    if state is None:
        raise DataError(folder / "checkpoints", "no best checkpoint: the run held no frames back for validation.")
    return state["model"], int(state["step"]), float(state["seconds"])
