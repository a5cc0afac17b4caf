"""Settings dataclasses to and from plain dictionaries, strictly: a misspelt option is an error, never ignored."""

from __future__ import annotations

import math
import types
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from avatar.checks import AvatarError, did_you_mean, sentences, unknown_name

FileName = Annotated[str, "a name, or the path of a file"]
Settings = TypeVar("Settings")


def settings_to_dict(settings: Any) -> Any:
    """A settings dataclass as nested plain dictionaries, lists and scalars, ready for JSON or YAML."""
    if is_dataclass(settings):
        return {f.name: settings_to_dict(getattr(settings, f.name)) for f in fields(settings)}
    if isinstance(settings, (list, tuple)):
        return [settings_to_dict(value) for value in settings]
    if isinstance(settings, dict):
        return {key: settings_to_dict(value) for key, value in settings.items()}
    if isinstance(settings, Enum):
        return settings.value
    return str(settings) if isinstance(settings, Path) else settings


def settings_from_dict(kind: type[Settings], values: dict[str, Any], name: str = "") -> Settings:
    """Builds a settings dataclass from plain values, nested alike; missing keys keep their defaults.

    Raises `AvatarError`, with ``name`` for where these options stand, on an unknown option (with the nearest name), a
    value of the wrong type, or one that the class's ``__post_init__`` refuses.
    """
    hints = get_type_hints(kind)
    for key in values:
        if key not in hints:
            known = f"There are: {', '.join(hints)}."
            raise AvatarError(sentences(f"{name}{key}: no such option.", did_you_mean(str(key), hints), known))
    converted = {key: convert_value(hints[key], value, f"{name}{key}") for key, value in values.items()}
    try:
        return kind(**converted)
    except AvatarError as error:  # ranges are checked by the class, which does not know where its options stand
        raise AvatarError(f"{name}{error}") from error


def convert_value(hint: Any, value: Any, name: str) -> Any:
    """One plain value as its declared type: scalars, enums, paths, optionals, tuples, lists, dicts, dataclasses.

    Raises `AvatarError` naming the option, the type expected and the value that came.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in inner:
            return None
        return convert_value(next(kind for kind in inner if kind is not type(None)), value, name)
    if isinstance(value, float) and not math.isfinite(value):
        raise AvatarError(f"{name}: expected a finite number, got {value}.")
    if hint is Any or (isinstance(hint, type) and not is_dataclass(hint) and type(value) is hint):
        return value
    if is_dataclass(hint) and isinstance(value, dict):
        return settings_from_dict(hint, value, f"{name}.")
    if origin in (tuple, list) and isinstance(value, (list, tuple)):
        items = [convert_value(inner[0], item, f"{name}[{i}]") for i, item in enumerate(value)]
        return origin(items)
    if origin in (tuple, list) and not isinstance(value, dict) and inner[0] in (str, Path):
        return origin([convert_value(inner[0], value, name)])  # outfit=dress stands for outfit=[dress]
    if origin is dict and isinstance(value, dict):
        return {key: convert_value(inner[1], item, f"{name}.{key}") for key, item in value.items()}
    if isinstance(hint, type) and issubclass(hint, Enum):
        if value in [member.value for member in hint]:
            return hint(value)
        raise unknown_name(name, str(value), [str(member.value) for member in hint])
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if isinstance(value, hint if isinstance(hint, type) else ()) and type(value) is not bool:
        return value
    raise AvatarError(f"{name}: expected {getattr(hint, '__name__', hint)}, got {value!r} ({type(value).__name__}).")
