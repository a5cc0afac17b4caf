"""The report of a run: one HTML page without scripts or outside requests, for light, dark, narrow and paper."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template
from urllib.parse import quote

import numpy as np

import avatar
from avatar.checks import AvatarError, check_shape, require
from avatar.evaluation.plots import inline_svg, plot_losses
from avatar.evaluation.tables import Table
from avatar.io.npz import write_whole

COLUMNS = ("ground truth", "prediction", "template", "mesh", "error")
STYLE = """
:root { color-scheme: light dark; --page: #f6f6f3; --card: #fff; --ink: #1c2027; --soft: #646b76; --line: #e2e2dd;
  --accent: #2f6fc9; --missing: #9a6a12; --paper: #fff; }
@media (prefers-color-scheme: dark) { :root { --page: #13151a; --card: #1c1f26; --ink: #e7e9ed; --soft: #9aa2af;
  --line: #2f343e; --accent: #7fb0f5; --missing: #e0b25c; --paper: #e9eaec; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.55 system-ui, sans-serif; }
header, main, footer { max-width: 1120px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 40px; }
h1 { margin: 0 0 4px; font-size: 30px; line-height: 1.2; letter-spacing: -0.02em; overflow-wrap: anywhere; }
h2 { margin: 0 0 16px; font-size: 19px; letter-spacing: -0.01em; }
h3 { margin: 24px 0 8px; font-size: 15px; }
p { max-width: 75ch; }
a { color: var(--accent); }
nav { display: flex; flex-wrap: wrap; gap: 4px 18px; margin: 18px 0 22px; font-size: 14px; }
nav a { text-decoration: none; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 12px; padding: 22px 24px;
  margin-bottom: 20px; }
.soft, footer { color: var(--soft); font-size: 13px; }
footer { padding-bottom: 40px; }
.missing { color: var(--missing); }
.missing::before { content: "\\2014\\00a0"; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin: 16px 0 0; }
.facts div { border: 1px solid var(--line); border-radius: 10px; padding: 10px 14px; }
.facts dt { color: var(--soft); font-size: 12.5px; }
.facts dd { margin: 0; font-size: 19px; font-weight: 600; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; min-width: 50%; }
th, td { padding: 6px 14px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
th { font-weight: 600; }
thead th { color: var(--soft); font-size: 13px; }
tbody th, thead th:first-child { text-align: left; font-weight: 500; }
tr.summary { background: color-mix(in srgb, var(--ink) 5%, transparent); font-weight: 600; }
.notes { margin: 12px 0 0; padding-left: 18px; color: var(--soft); font-size: 13px; }
.notes li { margin: 2px 0; }
.plot svg { display: block; width: 100%; height: auto; margin: 0 auto; }
pre { margin: 0; max-height: 480px; overflow: auto; font: 12.5px/1.5 ui-monospace, monospace; tab-size: 2; }
.pictures { display: grid; gap: 8px; min-width: calc(var(--columns) * 130px);
  grid-template-columns: repeat(var(--columns), minmax(0, 1fr)); }
.pictures .head { color: var(--soft); font-size: 13px; font-weight: 600; }
.pictures .pose { grid-column: 1 / -1; margin-top: 10px; font-size: 13.5px; font-weight: 600; overflow-wrap: anywhere; }
figure { margin: 0; }
figure img { display: block; width: 100%; height: auto; background: var(--paper); border-radius: 8px; }
figcaption { color: var(--soft); font-size: 12.5px; margin-top: 4px; }
.files { margin: 0; padding: 0; list-style: none; columns: 2 340px; font-size: 13.5px; }
.files li { padding: 2px 0; overflow-wrap: anywhere; break-inside: avoid; }
@media (max-width: 640px) { header, main, footer { padding-left: 14px; padding-right: 14px; }
  section { padding: 16px; } h1 { font-size: 24px; } }
@media print { :root { --page: #fff; --card: #fff; --ink: #000; --soft: #444; --line: #ccc; color-scheme: light; }
  nav { display: none; } section { border: 0; padding: 8px 0; } figure, table, .plot { break-inside: avoid; }
  pre { max-height: none; white-space: pre-wrap; } }
"""

PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<link rel="icon" href="data:,">
<title>$title</title>
<style>$style</style>
</head>
<body>
<header>
<h1>$title</h1>
<div class="soft">$subtitle</div>
<nav>$links</nav>
</header>
<main>
$sections
</main>
<footer>$footer</footer>
</body>
</html>
""")


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
    """What a report shows; pictures, tables and a training log that are not there are called missing on the page."""

    title: str
    subtitle: str = ""
    summary: str = ""  # paragraphs of plain text, an empty line between them
    facts: dict[str, str] = field(default_factory=dict)  # headline numbers, shown as cards
    config_yaml: str = ""
    metrics_csv: Path | None = None
    tables: tuple[Table, ...] = ()
    pictures: tuple[PictureRow, ...] = ()
    files: tuple[Path, ...] = ()


def write_report(run_folder: str | Path, content: ReportContent) -> Path:
    """Writes ``report.html`` into a run's folder and returns its path. Raises `AvatarError` when a picture is not an
    image, or a row has another number of pictures than columns, and `DataError` when the training log is there and
    cannot be read.
    """
    folder, log = Path(run_folder), content.metrics_csv
    training = _missing(f"No training log{f' at {log}' if log else ''}, so there are no loss curves.")
    if log and Path(log).is_file():
        training = f'<div class="plot">{inline_svg(plot_losses(log), "losses", "Loss terms over training steps")}</div>'
    paragraphs = [f"<p>{escape(part)}</p>" for part in content.summary.split("\n\n")]
    facts = [f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in content.facts.items()]
    sections = {
        "Summary": f'{"".join(paragraphs)}\n<dl class="facts">{"".join(facts)}</dl>',
        "Pictures": _pictures(content) if content.pictures else _missing("No pictures were made for this run."),
        "Metrics": _metrics(content),
        "Training": training,
        "Configuration": f"<pre>{escape(content.config_yaml)}</pre>",
        "Files": f'<ul class="files">{"".join(_file(folder, Path(file)) for file in content.files)}</ul>',
    }
    page = PAGE.substitute(
        title=escape(content.title),
        subtitle=escape(content.subtitle),
        style=STYLE,
        links=" ".join(f'<a href="#{heading.lower()}">{heading}</a>' for heading in sections),
        sections="\n".join(
            f'<section id="{heading.lower()}">\n<h2>{heading}</h2>\n{body}\n</section>'
            for heading, body in sections.items()
        ),
        footer=f"Written by avatar {avatar.__version__}.",
    )
    write_whole(folder / "report.html", page.encode())
    return folder / "report.html"


def picture_source(image: np.ndarray) -> str:
    """An image ``(H, W, 3 or 4)`` uint8 as a WebP data URI; an `AvatarError` for any other or an empty one."""
    image = np.asarray(image)
    check_shape("image", image, "H W C")
    if image.dtype != np.uint8 or image.shape[2] not in (3, 4) or not image.size:
        raise AvatarError(f"image: expected (H, W, 3 or 4) uint8 pixels, got {image.shape} {image.dtype}.")
    data = io.BytesIO()
    require("PIL.Image").fromarray(np.ascontiguousarray(image)).save(data, format="WEBP", quality=90, method=4)
    return f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode('ascii')}"


def _missing(text: str) -> str:
    return f'<p class="missing">{escape(text)}</p>'


def _pictures(content: ReportContent) -> str:
    cells = [f'<div class="head">{escape(column)}</div>' for column in COLUMNS]
    for row in content.pictures:
        if len(row.pictures) != len(COLUMNS):
            raise AvatarError(
                f"pictures: expected {len(COLUMNS)} for {row.title!r} ({', '.join(COLUMNS)}; None "
                f"where there is none), got {len(row.pictures)}."
            )
        cells.append(f'<div class="pose">{escape(row.title)}</div>')
        for picture, column in zip(row.pictures, COLUMNS):
            cell = _missing(f"no {column}")
            if picture is not None:
                source, (height, width) = picture_source(picture.image), picture.image.shape[:2]
                cell = f'<img src="{source}" alt="{escape(picture.alt)}" width="{width}" height="{height}">'
                cell += f"<figcaption>{escape(picture.caption)}</figcaption>" if picture.caption else ""
            cells.append(f"<figure>{cell}</figure>")
    grid = "\n".join(cells)
    return f'<div class="wide"><div class="pictures" style="--columns:{len(COLUMNS)}">\n{grid}\n</div></div>'


def _metrics(content: ReportContent) -> str:
    parts = [] if content.tables else [_missing("No predictions of this run were scored.")]
    for table in content.tables:
        head = "".join(f'<th scope="col">{escape(column)}</th>' for column in (table.corner, *table.heads))
        rows = []
        for row in table.rows:
            cells = "".join(f"<td>{escape(cell)}</td>" for cell in row.cells)
            kind = ' class="summary"' if row.summary else ""
            rows.append(f'<tr{kind}><th scope="row">{escape(row.label)}</th>{cells}</tr>')
        body = f"<thead><tr>{head}</tr></thead>\n<tbody>" + "\n".join(rows) + "</tbody>"
        parts.append(f'<h3>{escape(table.title)}</h3>\n<div class="wide"><table>{body}</table></div>')
    notes = dict.fromkeys(note for table in content.tables for note in table.notes)
    if listed := "".join(f"<li>{escape(note)}</li>" for note in notes):
        parts.append(f'<h3>Definitions</h3>\n<ul class="notes">{listed}</ul>')
    return "\n".join(parts)


def _file(folder: Path, file: Path) -> str:
    """A file as a link relative to the report where it lies in the run, with its size."""
    whole, home = file.resolve(), folder.resolve()
    inside = whole.is_relative_to(home)
    shown = whole.relative_to(home).as_posix() if inside else str(file)
    name = f'<a href="{quote(shown)}">{escape(shown)}</a>' if inside else escape(shown)
    if file.is_dir():
        return f'<li>{name} <span class="soft">{sum(1 for _ in file.iterdir()):,} files</span></li>'
    if not file.is_file():
        return f'<li>{escape(shown)} <span class="missing">not there</span></li>'
    return f'<li>{name} <span class="soft">{file.stat().st_size / 1e6:.2f} MB</span></li>'
