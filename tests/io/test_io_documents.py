"""YAML and JSON read without trust: plain mappings pass, everything else is one error that names the file."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar.checks import DataError, check_name, plain_name
from avatar.io.documents import JSON_BYTES, YAML_BYTES, read_json, read_yaml

DEEP = 60
BAD = {
    "there is none": (None, "no such file"),
    "not text": (b"\xff\xfe\x00", "expected text"),
    "a list": (b"[1, 2]", "expected a mapping"),
    "numbers for names": (b"{1: 2}", "expected"),
    "deep": (b'{"a": ' + b"[" * DEEP * 2000, "expected"),
    "a number without end": (b'{"a": ' + b"9" * 5000 + b"}", "expected"),
}
ONLY_YAML = {
    "anchors": (b"a: &x [1]\nb: *x", "no anchors"),
    "levels": (b"a: " + b"[" * DEEP + b"]" * DEEP, "levels of nesting"),
    "objects": (b"a: !!python/object/apply:os.system [id]", "expected plain YAML"),
    "a date that is none": (b"a: 2001-99-99", "expected plain YAML"),
}


@pytest.mark.parametrize("what", BAD | ONLY_YAML)
def test_what_is_not_plain_is_refused(tmp_path, what):
    data, reason = (BAD | ONLY_YAML)[what]
    for name, read in (("a.yaml", read_yaml), ("a.json", read_json)):
        if what in ONLY_YAML and read is read_json:
            continue
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(DataError, match=reason) as caught:
            read(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)


def test_size_is_looked_at_before_anything_is_read(tmp_path):
    for name, read, limit in (("a.yaml", read_yaml, YAML_BYTES), ("a.json", read_json, JSON_BYTES)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(limit + 1)
        with pytest.raises(DataError, match="expected at most"):
            read(tmp_path / name)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_mapping_or_one_error(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    for read in (read_yaml, read_json):
        path.write_bytes(data)
        try:
            assert isinstance(read(path), dict)
        except DataError as error:
            assert str(path) in str(error)


@given(st.text(max_size=80))
def test_any_text_becomes_a_plain_name_that_stays_where_it_is_put(text):
    assert check_name("name", plain_name(text, "motion"))
