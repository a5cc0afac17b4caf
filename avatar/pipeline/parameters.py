"""How many parameters each method's network has, part by part, beside what is known of the original."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torch import nn

from avatar.evaluation.aggregate import grouped
from avatar.evaluation.scores import csv_text
from avatar.evaluation.tables import Table, TableRow, to_markdown
from avatar.io.npz import write_whole
from avatar.methods.registry import find_method
from avatar.methods.settings import MethodChoice
from avatar.records import Template
from avatar.settings import settings_from_dict

CODES, TOTAL = "codes of an outfit", "total without codes"
ORIGINAL = {  # counted in POP's own network at full size, codes apart
    ("pop", "pose encoder"): 10_348_192,
    ("pop", "garment encoder"): 307_200,
    ("pop", "pose decoder"): 600_326,
    ("pop", TOTAL): 11_255_718,
    ("pop", CODES): 1_048_576,
}


@dataclass
class ParametersConfig:
    """The table of every method's parameters at both sizes."""

    out: Path = Path("runs/tables")  # where parameters.csv and parameters.md go


class Count(NamedTuple):
    """The parameters of one part of a method's network at one size; ``original`` those of the authors', if known."""

    method: str
    size: str
    part: str
    parameters: int
    original: int | None


def build_network(choice: MethodChoice, template: Template) -> nn.Module:
    """A method's untrained network for one outfit; learned skinning fields, which runs bring along, are left out."""
    method = find_method(choice.name)
    return method.untrained(settings_from_dict(method.Settings, choice.settings), template)


def count_parameters(method: str, size: str, model: nn.Module) -> list[Count]:
    """A network's parts with parameters, their total, and the garment codes that come with every outfit."""
    parts = {name.replace("_", " "): sum(p.numel() for p in part.parameters()) for name, part in model.named_children()}
    codes = sum(p.numel() for name, p in model.named_parameters() if name == "codes")
    parts |= {TOTAL: sum(p.numel() for p in model.parameters()) - codes, CODES: codes}
    known = {part: ORIGINAL.get((method, part)) if size == "full" else None for part in parts}
    return [Count(method, size, part, count, known[part]) for part, count in parts.items() if count]


def write_parameters(folder: Path, choices: Mapping[tuple[str, str], MethodChoice], template: Template) -> str:
    """Writes ``parameters.csv`` and ``parameters.md`` for networks by method and size; gives the latter's text."""
    counts = []
    for (method, size), choice in choices.items():
        counts += count_parameters(method, size, build_network(choice, template))
    sizes = grouped(counts, lambda count: count.size)
    markdown = "\n".join(to_markdown(parameter_table(mine, size)) for size, mine in sizes.items())
    write_whole(folder / "parameters.csv", csv_text(Count._fields, counts).encode())  # None is an empty field
    write_whole(folder / "parameters.md", markdown.encode())
    return markdown


def parameter_table(counts: list[Count], size: str) -> Table:
    """Methods by parts at one size, with the originals below the methods they are of."""
    parts = [*dict.fromkeys(c.part for c in counts if c.part not in (TOTAL, CODES)), TOTAL, CODES]
    body = []
    for method, mine in grouped(counts, lambda count: count.method).items():
        originals = {count.part: count.original for count in mine if count.original}
        lines = {method: {count.part: count.parameters for count in mine}, f"{method}, original": originals}
        for label, line in lines.items():
            texts = tuple(f"{line[part]:,}" if part in line else "–" for part in parts)
            body += [TableRow(label, tuple(map(line.get, parts)), texts=texts)] if line else []
    note = "One outfit on the open body. Skinning fields of canonicalizers are not counted."
    return Table(f"parameters, size={size}", "method", tuple(parts), tuple(body), (note,))
