"""Property tests of the readers: for any bytes, a valid value or one error that names the file."""

import random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from avatar.checks import AvatarError
from reliability.formats import FORMATS


@st.composite
def mutated(draw, data: bytes) -> bytes:
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
def test_a_mutated_file_is_valid_or_refused_by_name(good, data):
    kind, path, valid = good
    path.write_bytes(data.draw(mutated(valid)))
    try:
        value = kind.read(path)
    except AvatarError as error:
        assert str(path.parent) in str(error)
    else:
        assert kind.validate(value) == ""


@pytest.mark.parametrize("name", [name for name, kind in FORMATS.items() if kind.mutate_values])
def test_good_files_are_read_and_valid(name, tmp_path):
    kind = FORMATS[name]
    path = kind.make(tmp_path)
    assert kind.validate(kind.read(path)) == ""
    data = path.read_bytes()
    assert any(kind.mutate_values(data, random.Random(seed)) != data for seed in range(5))
