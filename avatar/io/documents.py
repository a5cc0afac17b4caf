"""Settings and descriptions on disk, YAML and JSON: read without trust into plain mappings of bounded size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from avatar.checks import DataError, check_file

YAML_BYTES = 1 << 17  # a run's own config.yaml has 5 kB; this many take a second to parse
JSON_BYTES = 64 << 20
MAX_DEPTH = 50


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file that holds one mapping of plain values.

    Tags that make objects are refused by the safe loader; anchors, which let a kilobyte stand for a gigabyte, and
    nesting deeper than 50 are refused here, before anything is built.

    Raises:
        DataError: for a missing, oversized or damaged file, or one that holds anything else.
    """
    text = _read_text(path, YAML_BYTES)
    try:
        check_events(path, text)
        values = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(path, f"expected plain YAML: {error!s:.300}.") from error
    return _check_mapping(path, values)


def check_events(path: Path, text: str) -> list[str]:
    """Refuses anchors and deep nesting in YAML text; gives its scalars, keys and values alike, unescaped."""
    depth, scalars = 0, []
    for event in yaml.parse(text, yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH or getattr(event, "anchor", None):
            raise DataError(path, f"expected no anchors and at most {MAX_DEPTH} levels of nesting, got others.")
        if isinstance(event, yaml.ScalarEvent):
            scalars.append(event.value)
    return scalars


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file that holds one object.

    Raises:
        DataError: for a missing, oversized or damaged file, or one that holds anything else.
    """
    text = _read_text(path, JSON_BYTES)
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"expected JSON: {error!s:.300}.") from error
    return _check_mapping(path, values)


def _read_text(path: Path, limit: int) -> str:
    check_file(path, limit)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(path, f"expected text, reading failed: {error}.") from error


def _check_mapping(path: Path, values: Any) -> dict[str, Any]:
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise DataError(path, f"expected a mapping of names to values, got {type(values).__name__}.")
    return values
