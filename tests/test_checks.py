"""The checks at public borders and what their messages say."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from avatar.checks import AvatarError, DataError, check_finite, check_range, check_shape, require
from avatar.invocation import EXTRAS


def test_check_shape_returns_named_sizes_for_arrays_and_tensors():
    assert check_shape("points", np.zeros((2, 5, 3)), "B N 3") == {"B": 2, "N": 5}
    assert check_shape("points", torch.zeros(2, 5, 3), "B N 3", B=2) == {"B": 2, "N": 5}
    assert check_shape("square", np.zeros((4, 4)), "N N") == {"N": 4}
    assert check_shape("number", np.zeros(()), "") == {}


@pytest.mark.parametrize("shape", [(3, 3), (7, 3, 3), (2, 7, 3, 3)])
def test_check_shape_leading_dots_stand_for_any_dimensions(shape):
    assert check_shape("rotation", np.zeros(shape), "... 3 3") == {}


@pytest.mark.parametrize(
    ("shape", "pattern", "dims"),
    [
        ((5, 3), "B N 3", {}),
        ((2, 5, 4), "B N 3", {}),
        ((1, 2, 5, 3), "B N 3", {}),
        ((2, 5, 3), "B N 3", {"N": 6}),
        ((4, 5), "N N", {}),
        ((3,), "... 3 3", {}),
        ((), "3", {}),
    ],
)
def test_check_shape_refuses_what_does_not_fit(shape, pattern, dims):
    with pytest.raises(AvatarError):
        check_shape("value", np.zeros(shape), pattern, **dims)


def test_check_shape_message_names_argument_pattern_bound_sizes_and_what_came():
    with pytest.raises(AvatarError) as caught:
        check_shape("anchors", torch.zeros(2, 4, 3), "B N 3", B=2, N=5)
    assert str(caught.value) == "anchors: expected shape (B, N, 3) with B=2, N=5, got (2, 4, 3)."
    with pytest.raises(AvatarError, match=r"points: expected shape \(N, 3\), got list\."):
        check_shape("points", [[0, 0, 0]], "N 3")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("make", [np.array, torch.tensor])
def test_check_finite_counts_and_places_what_is_not(make, bad):
    values = [[0.0, 1.0], [bad, bad]]
    with pytest.raises(AvatarError, match=r"scan: .*2 NaN or infinite values of 4 \(first at index \(1, 0\)\)"):
        check_finite("scan", make(values))


@pytest.mark.parametrize("good", [np.zeros((0, 3)), np.arange(4), torch.ones(3, requires_grad=True), 1.5])
def test_check_finite_lets_numbers_pass(good):
    check_finite("value", good)


@pytest.mark.parametrize(
    ("value", "bounds", "expected"),
    [
        (0, {"low": 1}, "at least 1"),
        (0.0, {"above": 0}, "above 0"),
        (2, {"above": 0, "high": 1}, "above 0 and at most 1"),
        (float("nan"), {"low": 0}, "at least 0"),
    ],
)
def test_check_range_names_the_field_its_range_and_its_value(value, bounds, expected):
    settings = SimpleNamespace(steps=1, size=value, limit=None)
    with pytest.raises(AvatarError, match=f"^size: expected {expected}, got {value}\\.$"):
        check_range(settings, "steps", "limit", "size", **bounds)


def test_check_range_lets_bounds_and_missing_limits_pass():
    settings = SimpleNamespace(low=1, high=3, limit=None)
    check_range(settings, *vars(settings), low=1, high=3)
    check_range(settings, *vars(settings), above=0.9)
    check_range(SimpleNamespace(stretch=float("inf")), "stretch", above=1)


def test_data_error_names_the_file_and_the_mend_and_is_an_avatar_error():
    error = DataError("scans/a.npz", "expected points, found none.", "Scan again.")
    assert str(error) == "scans/a.npz: expected points, found none. Scan again."
    assert isinstance(error, AvatarError) and isinstance(error, ValueError) and error.path.name == "a.npz"


def test_require_gives_the_module_or_the_line_that_installs_it(monkeypatch):
    assert require("numpy") is np
    with pytest.raises(AvatarError, match=r"is needed here .* Run: \S*python -m pip install no_such_thing$"):
        require("no_such_thing")
    monkeypatch.setitem(EXTRAS, "no_such_thing", "thing")
    with pytest.raises(AvatarError, match=r"-m pip install -e '\S+\[thing\]'$"):
        require("no_such_thing.part")


def test_require_turns_a_missing_system_library_into_the_same_error(tmp_path, monkeypatch):
    """open3d without libGL raises OSError at import, not ImportError."""
    (tmp_path / "broken_wheel.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(AvatarError, match=r"libGL\.so\.1.*Run:"):
        require("broken_wheel")
