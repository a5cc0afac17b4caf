"""The help of every verb: what it says, and that it costs little."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from avatar.arguments import help_text, known_options, main_option, meanings
from avatar.config import register
from avatar.declared import declared
from avatar.verbs import OPTIONS, SHARED, VERBS, typed_words

ROOT = Path(__file__).parents[1]
WITH_OPTIONS = list(OPTIONS)
SECONDS = 2.0  # of processor time


def ask(*words: str) -> tuple[int, str, str, float]:
    """Exit code, output, errors and processor seconds of a verb, with what it imported among the errors."""
    line = [sys.executable, "-X", "importtime", "-m", "avatar", *words]
    process = subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err, children_seconds()


def children_seconds() -> float:
    """Processor time of all processes that this one has waited for."""
    times = os.times()
    return times.children_user + times.children_system


@pytest.mark.parametrize("verb", ["--help", *VERBS])
def test_help_needs_neither_torch_nor_two_seconds(verb):
    before = children_seconds()
    code, out, err, after = ask(*([verb] if verb == "--help" else [*typed_words(verb), "--help"]))
    assert code == 0 and out.startswith("usage: ") and " torch\n" not in err and " scipy\n" not in err
    assert after - before < SECONDS


def test_a_mistake_is_found_before_torch_is_imported():
    for verb, word, message in (
        ("train", "train.stepz=1", "train.stepz: no such option."),
        ("train", "train.steps=many", "train.steps: expected int, got 'many'"),
        ("train", "outfit=nowhere", "nowhere: no such outfit. There are: dress, tee."),
        ("demo", "outfit=[dress,coat]", "coat: no such outfit."),
        ("fit", "run=nowhere", "no such file."),
        ("predict", "run=nowhere", "no such file."),
    ):
        before = children_seconds()
        code, _, err, after = ask(verb, word)
        assert code == 2 and " torch\n" not in err and message in err
        assert after - before < SECONDS


@pytest.mark.parametrize("verb", WITH_OPTIONS)
def test_the_options_that_matter_exist_and_mean_something(verb):
    register(verb)
    options, choices = known_options(verb, [])
    known = meanings(declared(VERBS[verb].settings), options)
    assert VERBS[verb].settings and len(OPTIONS[verb].split()) <= 12
    for name in OPTIONS[verb].split():
        assert main_option(name, options, choices, known)[1], name


def test_shared_meanings_are_of_options_that_lack_one():
    known: dict[str, list[str]] = {name: [] for name in SHARED}
    for verb in WITH_OPTIONS:
        register(verb)
        options, _ = known_options(verb, [])
        for name, meaning in meanings(declared(VERBS[verb].settings), options).items():
            known.setdefault(name, []).append(meaning)
    assert all(known[name].count(meaning) > 1 for name, meaning in SHARED.items() if name != "seed")


def test_help_shows_what_the_command_line_chooses():
    register("train")
    text = help_text("train", VERBS["train"], ["method=pop", "train.minutes=3"])
    assert re.search(r"\n  method=pop +POP: features in the UV plane", text) and "\n  train.minutes=3  " in text
    assert "\n    closet_learned    CloSET skinned by" in text and "\n      map_size: 64" in text
    assert "\n      chamfer: plane  # point, plane\n" in text and "method_size" not in text and "_defaults" not in text
    assert text.index("train.minutes=3") < text.index("All options:") < text.index("Options are written NAME=VALUE")


def test_help_of_a_mistyped_option_is_a_hint():
    code, out, err, _ = ask("train", "methd=pop", "--help")
    assert code == 2 and out == "" and "methd: no such option. Did you mean 'method" in err
