"""Settings and descriptions on disk, YAML and JSON: read without trust into plain mappings of bounded size."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from avatar.checks import DataError, check_file

YAML_BYTES = 1 << 17  # a run's own config.yaml has 5 kB; this many take a second to parse
JSON_BYTES = 64 << 20
MAX_DEPTH = 50


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file that holds one mapping of plain values; `DataError` for anything else, and for files too large.

    The safe loader refuses tags that make objects; anchors (a kilobyte may stand for a gigabyte) and deep nesting are
    refused before anything is built.
    """

    def parse(text: str) -> Any:
        check_events(path, text)
        return yaml.safe_load(text)

    return _read_mapping(path, YAML_BYTES, "plain YAML", parse)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file that holds one object. Raises `DataError` as `read_yaml` does."""
    return _read_mapping(path, JSON_BYTES, "JSON", json.loads)


def read_json_record(path: Path) -> dict[str, Any]:
    """The one object of a JSON file: as `read_json`, or alone in an array, or in an array under ``annots``.

    EasyMocap writes an array of the people in a frame. Raises `DataError` for several.
    """

    def parse(text: str) -> Any:
        values = json.loads(text)
        if isinstance(values, dict) and isinstance(values.get("annots"), list):
            values = values["annots"]
        if isinstance(values, list) and len(values) != 1:
            raise DataError(path, f"expected one person, got {len(values)}.", "Hint: write one file a person.")
        return values[0] if isinstance(values, list) else values

    return _read_mapping(path, JSON_BYTES, "JSON", parse)


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


def _read_mapping(path: Path, limit: int, kind: str, parse: Callable[[str], Any]) -> dict[str, Any]:
    check_file(path, limit)
    try:
        values = parse(path.read_text(encoding="utf-8"))
    except DataError:
        raise
    except UnicodeDecodeError as error:
        raise DataError(path, f"expected text, reading failed: {error}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DataError(path, f"expected {kind}: {error!s:.300}.") from error
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise DataError(path, f"expected a mapping of names to values, got {type(values).__name__}.")
    return values
