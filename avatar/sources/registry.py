"""Layouts of data sets by name, and the outfits that a folder holds."""

from __future__ import annotations

from pathlib import Path

from avatar.checks import AvatarError, DataError, did_you_mean, sentences, unknown_name
from avatar.sources.base import Source, SourceConfig
from avatar.sources.plain import PlainScans

# in the order in which they are looked for; plain folders last
LAYOUTS: dict[str, type[Source]] = {kind.layout: kind for kind in (PlainScans,)}


def open_sources(config: SourceConfig) -> list[Source]:
    """The outfits of a data set or of a folder of scans, by their names.

    Raises `DataError` for a folder of none of the layouts; `AvatarError` for unknown layouts and outfits, naming those
    there are.
    """
    path = Path(config.source)
    if config.layout not in ("auto", *LAYOUTS):
        raise unknown_name("layout", config.layout, ("auto", *LAYOUTS))
    if not path.is_dir():
        raise DataError(path, "expected a folder of scans, there is none.")
    kinds = list(LAYOUTS.values()) if config.layout == "auto" else [LAYOUTS[config.layout]]
    kind, found = next(((kind, found) for kind in kinds if (found := kind.find(path))), (None, {}))
    if kind is None:
        expected = config.layout if config.layout != "auto" else f"one of {', '.join(LAYOUTS)}"
        hint = "docs/own_scans.md shows the files of each."
        raise DataError(path, f"expected files of layout {expected}, found none.", f"Hint: {hint}")
    unknown = [name for name in config.outfits if name not in found]
    if unknown:
        known = ", ".join(list(found)[:20])
        raise AvatarError(
            sentences(f"outfits: expected some of {known}, got {unknown[0]!r}.", did_you_mean(unknown[0], found))
        )
    return [
        kind(folder, name, config) for name, folder in found.items() if not config.outfits or name in config.outfits
    ]
