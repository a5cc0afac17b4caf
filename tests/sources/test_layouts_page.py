"""docs/layouts.md: layouts, lists and splits are those there are, and every option of ours that it names is one."""

import re
from pathlib import Path

from avatar.config import compose_settings
from avatar.sources.conversion import ConvertConfig
from avatar.sources.published import published_outfits, published_splits
from avatar.sources.registry import LAYOUTS

PAGE = (Path(__file__).parents[2] / "docs" / "layouts.md").read_text()
OPTION = re.compile(r"`([a-z_.]+=[^`\s]+)`")
VERB = re.compile(r"of `((?:train|canonicalize|data convert)[^`]*)`")


def test_every_layout_is_on_the_page_as_errors_show_it():
    for name, kind in LAYOUTS.items():
        if kind.expected:  # own folders of scans have a page of their own
            assert f"### {name}\n\n```\n{kind.expected}\n```" in PAGE and f"| `{name}` |" in PAGE
    for name in (*published_outfits(), *(f"split={split}" for split in published_splits())):
        assert f"`{name}`" in PAGE


def test_options_in_place_of_theirs_are_known():
    count = 0
    for row in PAGE.partition("## Their options")[2].splitlines():
        for part in row.split(", or "):
            if verb := VERB.search(part):
                given = OPTION.findall(part.replace(verb[0], ""))
                name, *words = verb[1].split()
                if name == "data":
                    ConvertConfig(**{key: int(value) for key, value in (option.split("=") for option in given)})
                else:
                    compose_settings(name, *words, *given)
                count += len(given)
    assert count == 23
