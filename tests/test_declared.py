"""Settings classes as their source declares them are those that their modules define."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from avatar.declared import comments, declared, method_settings
from avatar.methods.registry import METHODS
from avatar.settings import settings_to_dict
from avatar.verbs import VERBS, resolve

SETTINGS = [*(entry.settings for entry in VERBS.values() if entry.settings), *method_settings().values()]


@pytest.mark.parametrize("name", SETTINGS)
def test_fields_types_and_defaults_are_those_of_the_class(name):
    assert settings_to_dict(declared(name)()) == settings_to_dict(resolve(name)())
    assert list(shape(declared(name))) == list(shape(resolve(name)))


def shape(hint: Any) -> Iterator[str]:
    """A type with those that it is made of, in words."""
    yield hint.__name__ if isinstance(hint, type) else str(get_origin(hint))
    for part in get_args(hint):
        yield from shape(part)
    if is_dataclass(hint):
        for field in fields(hint):
            yield field.name
            yield from shape(get_type_hints(hint)[field.name])


def test_the_methods_settings_are_those_of_their_networks():
    declared_ones = {name: resolve(settings) for name, settings in method_settings().items()}
    assert {name: method.Settings for name, method in METHODS.items()} == declared_ones


def test_comments_are_those_behind_the_fields():
    found = comments(declared("avatar.pipeline.experiments:ExperimentConfig"))
    assert found["points"] == "predicted a frame" and found["name"] == ""
    assert found["outfit"] == "several train one network with a garment code each"  # of the class that it extends


def test_nothing_heavy_is_imported():
    code = f"import sys, avatar.declared as d; [d.declared(n) for n in {SETTINGS}]; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert not loaded & {"torch", "scipy", "hydra", "trimesh", "yaml", "tqdm"}
