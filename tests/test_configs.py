"""Every configuration composes and converts; a misspelt option, name or value is refused."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.errors import HydraException

from avatar.arguments import refuse_code
from avatar.checks import AvatarError, DataError
from avatar.config import CONF
from avatar.config import compose_settings as load
from avatar.methods.registry import find_method
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.verbs import VERBS, resolve, typed_words
from benchmarks import BENCH, FIT_BODIES
from reliability import CHECK_RELIABILITY

ROOT = Path(__file__).parents[1]
EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
METHODS = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
SIZES = sorted(path.stem for path in (CONF / "size").glob("*.yaml"))
WITH_SETTINGS = {name: verb for name, verb in VERBS.items() if verb.settings}
WITH_SETTINGS |= {"bench": BENCH, "fit_bodies": FIT_BODIES, "check_reliability": CHECK_RELIABILITY}


@pytest.mark.parametrize("name", WITH_SETTINGS)
def test_every_verb_composes_and_has_its_tool(name):
    verb = WITH_SETTINGS[name]
    assert type(load(name, verb=verb)) is resolve(verb.settings)
    tool, *rest = typed_words(name)
    assert (ROOT / "tools" / f"{tool}.py").is_file()
    assert (
        (verb.conf or CONF / f"{name}.yaml").read_text().startswith(f"# python tools/{' '.join([f'{tool}.py', *rest])}")
    )


@pytest.mark.parametrize("name", WITH_SETTINGS)
def test_no_option_of_a_verb_is_taken_for_a_choice_among_files(name):
    """An option with the name of a folder of `conf/` chooses one of its files, whatever verb it is given to."""
    verb = WITH_SETTINGS[name]
    defaults = yaml.safe_load((verb.conf or CONF / f"{name}.yaml").read_text())["defaults"]
    chosen = {str(key) for entry in defaults for key in entry}
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    assert groups & settings_to_dict(resolve(verb.settings)()).keys() <= chosen


@pytest.mark.parametrize("name", WITH_SETTINGS)
def test_every_verb_writes_below_the_roots_of_runs_and_data_unless_told_otherwise(name):
    """Trying something must not overwrite the published tables, nor anything else of the folder it is tried in."""
    paths = paths_of(load(name, verb=WITH_SETTINGS[name]))
    assert [(option, str(path)) for option, path in paths if path.parts[0] not in ("runs", "data")] == []


def paths_of(settings: Any, prefix: str = "") -> Iterator[tuple[str, Path]]:
    """Every path among a verb's settings, by the name of its option."""
    for field in fields(settings):
        value, name = getattr(settings, field.name), f"{prefix}{field.name}"
        if is_dataclass(value):
            yield from paths_of(value, f"{name}.")
        elif isinstance(value, Path):
            yield name, value
        elif isinstance(value, tuple):
            yield from ((name, item) for item in value if isinstance(item, Path))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", SIZES)
def test_every_method_and_size_gives_its_settings(method, size):
    config = load("train", f"method={method}", f"size={size}")
    settings = settings_from_dict(find_method(config.method.name).Settings, config.method.settings)
    assert config.method.variant == method
    assert config.train.points == {"full": 50_000, "small": 5_000}[size]
    if config.method.name == "closet":
        assert settings.pose == (method != "static")
        assert settings.template == (method != "csf")
        assert settings.code_channels == {"full": 64, "small": 16}[size]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", SIZES)
def test_no_size_overwrites_what_a_method_or_its_variant_fixes(method, size):
    composed = settings_to_dict(load("train", f"method={method}", f"size={size}"))
    for name, value in fixed_values(method).items():
        found: Any = composed
        for part in name.split("."):
            found = found[part]
        assert found == value, name


def fixed_values(method: str) -> dict[str, Any]:
    """The options that a method's file sets, and those of the method that it is a variant of, by full name."""
    plain = yaml.safe_load((CONF / "method" / f"{method}.yaml").read_text())
    included = [name for name in plain.pop("defaults") if isinstance(name, str) and "@" not in name]
    values = {name: value for base in included for name, value in fixed_values(base).items()}
    return values | dict(leaves(plain))


def leaves(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested options by their full names."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def test_a_loss_weight_that_a_paper_fixes_is_set_in_one_place():
    """Of the files that methods are composed of; `size/small.yaml` has a CPU's own for all methods."""
    files = [path for group in ("method", "method_size") for path in (CONF / group).glob("*.yaml")]
    plain = [leaves(yaml.safe_load(path.read_text()) or {}) for path in files]
    weights = [(name, value) for values in plain for name, value in values if ".loss." in name and value != "plane"]
    assert len(set(weights)) == len(weights) > 0


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes_and_says_how_to_run_it(experiment):
    config = load("experiment", f"experiment={experiment}")
    assert config.compare.table == experiment and config.run.name.startswith((experiment, "paper", "closet_pop"))
    assert set(config.score.metrics) == set(config.compare.metrics)
    lines = (CONF / "experiment" / f"{experiment}.yaml").read_text().splitlines()
    assert lines[:2] == ["# @package _global_", f"# python tools/experiment.py experiment={experiment}"]


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_no_two_jobs_of_an_experiment_share_a_folder(experiment):
    """Two values of each option that its file sweeps, in all combinations."""
    plain = yaml.safe_load((CONF / "experiment" / f"{experiment}.yaml").read_text())
    swept = {key: str(values).split(",")[:2] for key, values in plain["hydra"]["sweeper"]["params"].items()}
    folders = []
    for values in product(*swept.values()):
        choices = [f"{key}={value}" for key, value in zip(swept, values)]
        folders.append(load("experiment", f"experiment={experiment}", *choices).run.folder)
    assert len(set(folders)) == len(folders) > 1


def test_equal_time_instead_of_equal_steps_is_one_switch():
    steps = load("experiment", "experiment=closet5", "train.steps=70").run
    assert (steps.train.steps, steps.train.minutes, steps.name) == (70, None, "closet5_70steps_1_seed0")
    clock = load("experiment", "experiment=closet5", "budget=minutes", "train.minutes=0.5").run
    assert (clock.train.steps, clock.train.minutes, clock.name) == (1_000_000, 0.5, "closet5_0.5min_1_seed0")


def test_several_outfits_and_nested_options():
    config = load("train", "outfit=[dress,tee]", "train.loss.chamfer=plane", "method.settings.pose_noise=0.01")
    assert config.outfit == ("dress", "tee")
    assert config.train.loss.chamfer.value == "plane"
    assert config.method.settings["pose_noise"] == 0.01
    assert load("train", "outfit=tee").outfit == ("tee",)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("train.stepz=3", "stepz"),
        ("method=clsoet", "clsoet"),
        ("train.steps=many", "train.steps: expected int, got 'many'"),
        ("train.loss.chamfer=round", "expected one of point, plane"),
        ("train.steps=-1", "steps: expected at least 1"),
        ("name=../elsewhere", "name: expected a plain name"),
        ("method.name=closet2", None),
    ],
)
def test_what_is_wrong_is_refused(override, message):
    if message is None:
        with pytest.raises(AvatarError, match="expected one of closet"):
            find_method(load("train", override).method.name)
        return
    with pytest.raises((AvatarError, HydraException), match=message):
        load("train", override)


STRANGERS = {
    "callback": ("a.yaml", "# @package _global_\nhydra: {callbacks: {a: {_target_: os.system}}}"),
    "hidden word": ("a.yaml", '"hy\\x64ra": 1'),
    "package": ("a.yaml", "# @package hydra.launcher\nn_jobs: 1"),
    "defaults": ("a.yaml", "defaults: [x@hydra.sweeper: y]"),
    "object": ("group/a.yml", "model: {_target_: builtins.eval}"),
    "log handler": ("group/a.yaml", "x: {'()': os.system}"),
    "environment": ("a.yaml", "name: ${oc.env:HOME}"),
    "folder": ("hydra/launcher/a.yaml", "n_jobs: 1"),
    "tag": ("a.yaml", "a: !!python/name:os.system ''"),
}


@pytest.mark.parametrize("what", STRANGERS)
@pytest.mark.parametrize("option", ["--config-dir", "--config-d=", "-cd", "--config-path="])
def test_a_configuration_from_elsewhere_is_no_code(tmp_path, what, option):
    name, text = STRANGERS[what]
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    line = [f"{option}{tmp_path}"] if option.endswith("=") else [option, str(tmp_path)]
    with pytest.raises(DataError, match=path.name):
        refuse_code(["outfit=tee", *line])
    path.write_text("train:\n  lr: 0.001\nname: ${method.variant}\n")
    if what == "folder":
        path.unlink()
    refuse_code(line)


def test_hydra_looks_nowhere_else_and_loads_no_pickle():
    for argument in ("hydra.searchpath=[file:///tmp]", "+hydra.searchpath=[x]", "--experimental-rerun=job.pickle"):
        with pytest.raises(AvatarError, match="not taken here"):
            refuse_code([argument])


def test_bad_input_ends_in_one_line_and_code_2(tmp_path):
    command = [
        sys.executable,
        "tools/train.py",
        "dataset=nowhere",
        f"data_root={tmp_path}",
        f"hydra.run.dir={tmp_path}",
    ]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert "expected the folder of data set nowhere" in result.stderr


def test_a_multirun_goes_on_after_a_failure_and_names_it(tmp_path):
    command = [sys.executable, "tools/report.py", "-m", f"run={tmp_path}/one,{tmp_path}/two"]
    command += [f"hydra.sweep.dir={tmp_path}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2
    assert "2 failed" in result.stderr
    assert f"run={tmp_path}/one" in result.stderr and f"run={tmp_path}/two" in result.stderr


def test_a_run_takes_any_canonicalizer_by_name():
    """A group of the same name would take the option for a choice among its files."""
    assert load("train", "canonical=mine").canonical == "mine"
    assert load("experiment", "canonical=mine", "experiment=loose").canonical == "mine"
