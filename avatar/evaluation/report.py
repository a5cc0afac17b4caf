"""The report of a run: one self-contained HTML page that opens anywhere, offline, without scripts."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

import avatar
from avatar.checks import AvatarError, check_shape, require
from avatar.evaluation.page import assemble_page
from avatar.evaluation.plots import inline_svg, plot_losses
from avatar.evaluation.tables import Table
from avatar.io.npz import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = ("ground truth", "prediction", "template", "mesh", "error")
WEBP = {"format": "WEBP", "quality": 90, "method": 4}


@dataclass(frozen=True)
class Picture:
    """An image ``(H, W, 3 or 4)`` uint8 with the text that stands for it and, if wanted, a caption below it."""

    image: np.ndarray
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class PictureRow:
    """The pictures of one pose, one for each column of the report; None where one could not be made."""

    title: str
    pictures: tuple[Picture | None, ...]


@dataclass(frozen=True)
class ReportContent:
    """What a report shows. Whatever is left empty is said to be missing on the page, never skipped."""

    title: str
    subtitle: str = ""
    summary: str = ""  # paragraphs of plain text, an empty line between them
    facts: dict[str, str] = field(default_factory=dict)  # headline numbers, shown as cards
    config_yaml: str = ""
    metrics_csv: Path | None = None
    tables: tuple[Table, ...] = ()
    figures: tuple[tuple[str, Figure], ...] = ()  # more plots, each with its title, shown below the tables
    columns: tuple[str, ...] = COLUMNS
    pictures: tuple[PictureRow, ...] = ()
    files: tuple[Path, ...] = ()


def write_report(run_folder: str | Path, content: ReportContent) -> Path:
    """Writes ``report.html`` into a run's folder and returns its path.

    Raises:
        AvatarError: when a picture is not an image, or a row has another number of pictures than columns.
        DataError: when the training log is there and cannot be read.
    """
    folder = Path(run_folder)
    sections = {
        "Summary": _summary(content),
        "Pictures": _pictures(content),
        "Metrics": _metrics(content),
        "Training": _training(content.metrics_csv),
        "Configuration": _configuration(content.config_yaml),
        "Files": _files(folder, content.files),
    }
    page = assemble_page(content.title, content.subtitle, sections, f"Written by avatar {avatar.__version__}.")
    write_whole(folder / "report.html", page.encode())
    return folder / "report.html"


def picture_source(image: np.ndarray) -> str:
    """An image as a WebP data URI.

    Raises:
        AvatarError: when it is not ``(H, W, 3 or 4)`` uint8 with at least one pixel.
    """
    image = np.asarray(image)
    check_shape("image", image, "H W C")
    if image.dtype != np.uint8 or image.shape[2] not in (3, 4) or not image.size:
        raise AvatarError(f"image: expected (H, W, 3 or 4) uint8 pixels, got {image.shape} {image.dtype}.")
    data = io.BytesIO()
    require("PIL.Image").fromarray(np.ascontiguousarray(image)).save(data, **WEBP)
    return f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode('ascii')}"


def _missing(text: str) -> str:
    return f'<p class="missing">{escape(text)}</p>'


def _summary(content: ReportContent) -> str:
    paragraphs = [f"<p>{escape(part.strip())}</p>" for part in content.summary.split("\n\n") if part.strip()]
    facts = [f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in content.facts.items()]
    if facts:
        paragraphs.append('<dl class="facts">' + "".join(facts) + "</dl>")
    return "\n".join(paragraphs) or _missing("No summary was given.")


def _pictures(content: ReportContent) -> str:
    if not content.pictures:
        return _missing("No pictures were made for this run.")
    cells = [f'<div class="head">{escape(column)}</div>' for column in content.columns]
    for row in content.pictures:
        if len(row.pictures) != len(content.columns):
            raise AvatarError(
                f"pictures: expected {len(content.columns)} for {row.title!r} ({', '.join(content.columns)}; None "
                f"where there is none), got {len(row.pictures)}."
            )
        cells.append(f'<div class="pose">{escape(row.title)}</div>')
        cells += [_picture(picture, column) for picture, column in zip(row.pictures, content.columns)]
    grid = "\n".join(cells)
    return f'<div class="wide"><div class="pictures" style="--columns:{len(content.columns)}">\n{grid}\n</div></div>'


def _picture(picture: Picture | None, column: str) -> str:
    if picture is None:
        return f"<figure>{_missing('no ' + column)}</figure>"
    source, (height, width) = picture_source(picture.image), picture.image.shape[:2]
    caption = f"<figcaption>{escape(picture.caption)}</figcaption>" if picture.caption else ""
    size = f'width="{width}" height="{height}"'
    return f'<figure><img src="{source}" alt="{escape(picture.alt)}" {size}>{caption}</figure>'


def _metrics(content: ReportContent) -> str:
    parts = [_table(table) for table in content.tables] or [_missing("No predictions of this run were scored.")]
    for place, (title, figure) in enumerate(content.figures):
        parts.append(f"<h3>{escape(title)}</h3>\n{_plot(figure, f'figure{place}', title)}")
    notes = dict.fromkeys(note for table in content.tables for note in table.notes)
    if notes:
        listed = "".join(f"<li>{escape(note)}</li>" for note in notes)
        parts.append(f'<h3>Definitions</h3>\n<ul class="notes">{listed}</ul>')
    return "\n".join(parts)


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in (table.corner, *table.heads))
    rows = [
        ('<tr class="summary">' if row.summary else "<tr>")
        + f'<th scope="row">{escape(row.label)}</th>'
        + "".join(f"<td>{escape(cell)}</td>" for cell in row.cells)
        + "</tr>"
        for row in table.rows
    ]
    body = "\n".join(rows)
    return (
        f"<h3>{escape(table.title)}</h3>\n"
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'
    )


def _training(metrics_csv: Path | None) -> str:
    if metrics_csv is None or not Path(metrics_csv).is_file():
        place = f" at {metrics_csv}" if metrics_csv else ""
        return _missing(f"No training log{place}, so there are no loss curves.")
    return _plot(plot_losses(metrics_csv), "losses", "Loss terms over training steps")


def _plot(figure: Figure, prefix: str, title: str) -> str:
    return f'<div class="plot">{inline_svg(figure, prefix, title)}</div>'


def _configuration(config_yaml: str) -> str:
    return f"<pre>{escape(config_yaml)}</pre>" if config_yaml.strip() else _missing("No configuration was recorded.")


def _files(folder: Path, files: Sequence[Path]) -> str:
    if not files:
        return _missing("This run made no files.")
    return '<ul class="files">' + "".join(_file(folder, Path(file)) for file in files) + "</ul>"


def _file(folder: Path, file: Path) -> str:
    """A file as a link relative to the report where it lies in the run, with its size."""
    inside = file.resolve().is_relative_to(folder.resolve())
    shown = file.resolve().relative_to(folder.resolve()).as_posix() if inside else str(file)
    name = f'<a href="{quote(shown)}">{escape(shown)}</a>' if inside else escape(shown)
    if file.is_dir():
        return f'<li>{name} <span class="soft">{sum(1 for _ in file.iterdir()):,} files</span></li>'
    if not file.is_file():
        return f'<li>{escape(shown)} <span class="missing">not there</span></li>'
    return f'<li>{name} <span class="soft">{file.stat().st_size / 1e6:.2f} MB</span></li>'
