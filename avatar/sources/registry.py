"""Layouts of data sets by name, and the outfits that a folder holds."""

from __future__ import annotations

from pathlib import Path

from avatar.checks import AvatarError, DataError, did_you_mean, sentences, unknown_name
from avatar.sources.base import Source, SourceConfig
from avatar.sources.cape_raw import CapeRawSource
from avatar.sources.dress4d import Dress4dSource
from avatar.sources.fite import FiteSource
from avatar.sources.packed import PackedSource
from avatar.sources.plain import PlainScans
from avatar.sources.published import named_outfits
from avatar.sources.scanimate import ScanimateSource
from avatar.sources.thuman import ThumanSource

KINDS = (PackedSource, FiteSource, CapeRawSource, Dress4dSource, ScanimateSource, ThumanSource, PlainScans)
LAYOUTS: dict[str, type[Source]] = {kind.layout: kind for kind in KINDS}  # as they are looked for; plain folders last


def open_sources(config: SourceConfig) -> list[Source]:
    """The outfits of a data set or of a folder of scans, by their names; lists of published papers stand for theirs.

    Raises `DataError` for a folder of none of the layouts; `AvatarError` for unknown layouts and outfits, naming those
    there are.
    """
    path = Path(config.source)
    if config.layout not in ("auto", *LAYOUTS):
        raise unknown_name("layout", config.layout, ("auto", *LAYOUTS))
    kinds = list(LAYOUTS.values()) if config.layout == "auto" else [LAYOUTS[config.layout]]
    if not path.is_dir():
        problem = "expected a folder of scans, there is none."
        raise DataError(path, problem) if config.layout == "auto" else kinds[0].missing(path, problem)
    kind, found = next(((kind, found) for kind in kinds if (found := kind.find(path))), (None, {}))
    if kind is None:
        if config.layout != "auto":
            raise kinds[0].missing(path, f"expected files of layout {config.layout}, found none.")
        hint = "Hint: docs/layouts.md shows the files of each."
        raise DataError(path, f"expected files of one of the layouts {', '.join(LAYOUTS)}, found none.", hint)
    wanted = named_outfits(config.outfits)
    unknown = [name for name in wanted if name not in found]
    if unknown:
        known = ", ".join(list(found)[:20])
        raise AvatarError(
            sentences(f"outfits: expected some of {known}, got {unknown[0]!r}.", did_you_mean(unknown[0], found))
        )
    return [kind(folder, name, config) for name, folder in found.items() if not wanted or name in wanted]
