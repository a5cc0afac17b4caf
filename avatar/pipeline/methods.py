"""All methods behind one door: point avatars and SCANimate's implicit one are trained and loaded by a run's method."""

from __future__ import annotations

from pathlib import Path

from avatar.checks import unknown_name
from avatar.environment import prepared_process
from avatar.implicit.avatar import ImplicitAvatar
from avatar.io.documents import read_yaml
from avatar.training.implicit_runs import METHOD, load_implicit, train_implicit
from avatar.training.runs import RunConfig, TrainedAvatar, load_run, train_run
from avatar.verbs import METHOD_SETTINGS, resolve


def find_settings(name: str) -> type:
    """The settings class of a method by name.

    Raises:
        AvatarError: listing the methods there are.
    """
    if name not in METHOD_SETTINGS:
        raise unknown_name("method", name, METHOD_SETTINGS)
    return resolve(METHOD_SETTINGS[name])


@prepared_process()
def train(config: RunConfig) -> Path:
    """Trains a run by its method, or goes on with it; gives the run's folder."""
    find_settings(config.method.name)
    return train_implicit(config) if config.method.name == METHOD else train_run(config)


def load_avatar(folder: Path, checkpoint: str = "last", device: str = "auto") -> TrainedAvatar:
    """The trained avatar of a run's folder, whatever its method; see `load_run`."""
    path = folder / "config.yaml"
    chosen = read_yaml(path).get("method") if path.is_file() else None
    implicit = isinstance(chosen, dict) and chosen.get("name") == METHOD
    return (load_implicit if implicit else load_run)(folder, checkpoint, device)


def is_implicit(avatar: TrainedAvatar) -> bool:
    """Whether an avatar is a surface of its own, extracted and posed, instead of points."""
    return isinstance(avatar.model, ImplicitAvatar)
