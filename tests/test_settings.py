"""Settings survive the way to plain values and back, and refuse what they do not know."""

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import pytest

from avatar.checks import AvatarError
from avatar.methods.closet import ClosetConfig
from avatar.methods.settings import TrainConfig
from avatar.settings import settings_from_dict, settings_to_dict


class Colour(Enum):
    red = "red"


@dataclass
class Inner:
    sizes: tuple[tuple[int, ...], ...] = ((1, 2), (3,))
    colour: Colour = Colour.red


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    rate: float = 0.1
    count: int = 3
    limit: float | None = None
    where: Path = Path("data")
    on: bool = True


@pytest.mark.parametrize("settings", [Outer(limit=2.0), ClosetConfig(template=False), TrainConfig(minutes=3.0)])
def test_round_trip(settings):
    assert settings_from_dict(type(settings), settings_to_dict(settings)) == settings


def test_numbers_that_are_none_and_ranges_are_refused_with_their_place():
    for value in (float("nan"), float("inf")):
        with pytest.raises(AvatarError, match="file: rate: expected a finite number"):
            settings_from_dict(Outer, {"rate": value}, "file: ")
    with pytest.raises(AvatarError, match="file: steps: expected at least 1"):
        settings_from_dict(TrainConfig, {"steps": 0}, "file: ")


def test_numbers_and_names_are_converted():
    made = settings_from_dict(Outer, {"rate": 2, "limit": 3, "where": "x", "inner": {"colour": "red", "sizes": [[4]]}})
    assert (made.rate, made.limit, made.where, made.inner.sizes) == (2.0, 3.0, Path("x"), ((4,),))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"ratee": 1}, "ratee: no such option. Did you mean 'rate'"),
        ({"inner": {"sizs": 1}}, r"inner\.sizs: no such option"),
        ({"rate": "fast"}, "rate: expected float, got 'fast'"),
        ({"count": 1.5}, "count: expected int, got 1.5"),
        ({"count": True}, "count: expected int, got True"),
        ({"on": 1}, "on: expected bool, got 1"),
        ({"inner": {"colour": "blue"}}, r"inner\.colour: expected one of red, got 'blue'"),
        ({"inner": {"sizes": [["a"]]}}, r"inner\.sizes\[0\]\[0\]: expected int"),
    ],
)
def test_wrong_values_are_refused_by_name(values, message):
    with pytest.raises(AvatarError, match=message):
        settings_from_dict(Outer, values)
