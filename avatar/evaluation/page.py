"""The frame of a report: one HTML page without scripts or outside requests, for light, dark, narrow and paper."""

from __future__ import annotations

from html import escape
from string import Template

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


def assemble_page(title: str, subtitle: str, sections: dict[str, str], footer: str) -> str:
    """A whole page. ``sections`` maps headings to HTML; the other arguments are plain text and are escaped."""
    anchors = {heading: heading.lower().replace(" ", "-") for heading in sections}
    links = [f'<a href="#{escape(anchor)}">{escape(heading)}</a>' for heading, anchor in anchors.items()]
    parts = [
        f'<section id="{escape(anchors[heading])}">\n<h2>{escape(heading)}</h2>\n{body}\n</section>'
        for heading, body in sections.items()
    ]
    return PAGE.substitute(
        title=escape(title),
        subtitle=escape(subtitle),
        style=STYLE,
        links=" ".join(links),
        sections="\n".join(parts),
        footer=escape(footer),
    )
