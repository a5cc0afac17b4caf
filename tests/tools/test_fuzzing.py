"""Readers fed by hypothesis: whatever the bytes, a sound value or one error that names the file."""

import random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from avatar.checks import AvatarError
from reliability.formats import FORMATS


@st.composite
def spoilt(draw, data: bytes) -> bytes:
    """Bytes with some of them changed, or a stretch replaced by another."""
    start = draw(st.integers(0, len(data)))
    stop = draw(st.integers(start, min(len(data), start + 64)))
    return data[:start] + draw(st.binary(max_size=32)) + data[stop:]


@pytest.fixture(scope="module", params=FORMATS)
def good(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    path = FORMATS[request.param].make(folder)
    return FORMATS[request.param], path, path.read_bytes()


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_a_spoilt_file_is_sound_or_refused_by_name(good, data):
    kind, path, sound = good
    path.write_bytes(data.draw(spoilt(sound)))
    try:
        value = kind.read(path)
    except AvatarError as error:
        assert str(path.parent) in str(error)
    else:
        assert kind.judge(value) == ""


@pytest.mark.parametrize("name", [name for name, kind in FORMATS.items() if kind.respoil])
def test_good_files_are_read_and_judged_sound(name, tmp_path):
    kind = FORMATS[name]
    path = kind.make(tmp_path)
    assert kind.judge(kind.read(path)) == ""
    data = path.read_bytes()
    assert any(kind.respoil(data, random.Random(seed)) != data for seed in range(5))
