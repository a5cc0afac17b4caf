"""Values of options as text: paths and names arrive as they were typed, and printed options are read back."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path

import hydra
import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from avatar.arguments import TextOption, text_options, tidy_arguments
from avatar.checks import AvatarError
from avatar.config import CONF, register
from avatar.declared import declared
from avatar.invocation import option
from avatar.settings import FileName
from avatar.verbs import VERBS

LETTERS = r"""
walk(2).npz 1.npz 007 1e5 a#1.npz a,b.npz it's.npz say"hi".npz both'"x [x].npz a[1 a]1 {x}.npz $HOME.npz ${x}.npz
${oc.env:HOME} a\${x} %d.npz a=b.npz ärger.npz 写真.npz true.npz true inf -x + ~nobody.npz 'q back\slash end\ a\'b a\"b
a\"'b *.npz ? x:y @a a|b !x & a;b <> `x` choice(a) null.npz .. ./a /tmp/a-b.c
"""
NAMES = [*LETTERS.split(), "a b.npz", " a ", "a\tb", "a\u0308rger.npz"]
LIKE_QUOTES = ["'q'", '"q"', "~", "~/a"]  # or like the home folder: as they are only where they are printed by us


def tidy(verb: str, *words: str) -> list[str]:
    """Words of a command line as Hydra gets them."""
    return tidy_arguments(list(words), text_options(declared(VERBS[verb].settings)))


def read(verb: str, *words: str) -> dict:
    """The options of a verb as they are composed from words of a command line."""
    register(verb)
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.to_container(hydra.compose(verb, tidy(verb, *words)), resolve=True)


@pytest.mark.parametrize("name", NAMES)
def test_a_path_arrives_as_it_was_typed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = read("predict", f"run={name}", f"motion={name}", f"+data_root={name}")
    assert {options["run"], options["motion"], options["data_root"]} == {name}


@pytest.mark.parametrize("name", [*NAMES, *LIKE_QUOTES])
def test_what_is_printed_for_a_shell_is_read_back(name):
    line = shlex.join([option("runs", [name, "b", name]), option("data_root", name)])
    options = read("evaluate", *shlex.split(line))
    assert options["runs"] == [name, "b", name] and options["data_root"] == name


@pytest.mark.parametrize("name", [*NAMES, *LIKE_QUOTES])
def test_jobs_of_a_multirun_get_the_path(name):
    """Hydra's sweeper writes each job's options anew."""
    overrides = OverridesParser.create().parse_overrides(tidy("predict", "-m", option("run", name), "motion=a,b")[1:])
    (batch,) = BasicSweeper.split_arguments(overrides, None)
    assert [read("predict", *job)["run"] for job in batch] == [name, name]


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("runs=[a b,c]", ["a b", "c"]),
        ("runs=[a, b]", ["a", "b"]),
        ("runs=[1,~/x,'~/y']", ["1", "HOME/x", "~/y"]),
        ('runs=["a,b",c(1)]', ["a,b", "c(1)"]),
        ("runs=[here,there,c]", ["here,there", "c"]),
        ("runs=[c,here,there]", ["c", "here,there"]),
        ("runs=here,there", "here,there"),
        ("runs=[a[1],b]", ["a[1]", "b"]),
        ("runs=[]", []),
        ("out=~/x", "HOME/x"),
        ("out='~/x'", "~/x"),
        ("out=x,y", "x,y"),
        ("out=null", None),
        ("out=", ""),
        ("label=2024", "2024"),
        ("label=true", "true"),
        ("data_root=NULL", None),
        ("outfit=null", "null"),
        ("score.metrics=[cd_point, normal_l1]", ["cd_point", "normal_l1"]),
    ],
)
def test_values_are_lists_paths_and_names_by_the_type_of_their_option(word, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "HOME")
    Path("here,there").touch()
    found = read("evaluate", word)
    for part in word.partition("=")[0].split("."):
        found = found[part]
    assert found == value


def test_a_list_of_paths_with_brackets_may_be_split_at_blanks():
    words = ["runs=[a[1],", "b", "c]", "split=test", "runs=[x]", "out=[y"]
    assert tidy("evaluate", *words) == ['runs=["a[1]","b c"]', "split=test", "runs=[x]", 'out="[y"']


def test_several_values_need_a_multirun(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("here", "there", "a,b"):
        Path(name).touch()
    assert tidy("predict", "-m", "run=here,there,x y") == ["-m", 'run=here,there,"x y"']
    assert tidy("predict", "-m", "run=here,a,b,c") == ["-m", 'run=here,"a,b",c']
    assert tidy("evaluate", "-m", "runs=[1,a,b],[c]") == ["-m", 'runs=["1","a,b"],[c]']
    for word in ("run=here,there", "run='c','d'"):
        with pytest.raises(AvatarError, match="for one job each put -m before the options"):
            tidy("predict", word)
    with pytest.raises(AvatarError, match=r"for a list write 'runs=\[here,there\]'"):
        tidy("evaluate", "runs=here,there")


def test_options_that_hold_text_are_known_by_their_types():
    @dataclass
    class Inner:
        folders: tuple[Path, ...] = ()

    @dataclass
    class Settings:
        path: Path = Path()
        absent: Path | None = None
        names: list[FileName] = field(default_factory=list)
        word: str = ""
        count: int = 0
        inner: Inner | None = None

    assert text_options(Settings) == {
        "path": TextOption(),
        "absent": TextOption(optional=True),
        "names": TextOption(several=True),
        "word": TextOption(path=False),
        "inner.folders": TextOption(several=True),
    }


def test_every_option_that_takes_a_file_is_known_as_one():
    found = {name for entry in VERBS.values() if entry.settings for name in paths(entry.settings)}
    assert {"run", "runs", "against", "motion", "out", "data_root", "runs_root", "root"} <= found
    assert {"shapes", "train_motions", "test_motions", "predictions", "canonicalizers", "compare.runs"} <= found
    assert {"canonicalizer.data_root", "compare.out"} <= found


def paths(settings: str) -> list[str]:
    """The options of a settings class that take paths."""
    return [name for name, known in text_options(declared(settings)).items() if known.path]
