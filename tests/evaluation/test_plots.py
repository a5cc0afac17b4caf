"""Plots: what they draw, and SVG that fits into a page."""

import re
from xml.etree import ElementTree

import pytest

from avatar.checks import DataError
from avatar.evaluation.plots import inline_svg, plot_losses, plot_outfits
from avatar.evaluation.scores import Score

LOG = "split,step,epoch,seconds,total,chamfer\ntrain,1,0,0.1,4,3\nvalidation,1,0,0.2,,5\ntrain,2,0,0.3,0.1,2\n"


@pytest.fixture
def log(tmp_path):
    (tmp_path / "metrics.csv").write_text(LOG)
    return tmp_path / "metrics.csv"


def test_losses_show_every_term_with_its_validation(log):
    total, chamfer = plot_losses(log).axes
    assert (total.get_title(), chamfer.get_title()) == ("total", "chamfer")
    assert total.lines[0].get_xydata().tolist() == [[1, 4], [2, 0.1]]
    assert [line.get_label() for line in chamfer.lines] == ["train", "validation"]
    assert chamfer.lines[1].get_xydata().tolist() == [[1, 5]]
    assert (total.get_yscale(), chamfer.get_yscale()) == ("log", "linear")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("step,total\n1,2\n", "split and step"),
        ("split,step,total\n", "no numbers"),
        (LOG + "train,3,0,1,x,1\n", "line 5"),
    ],
)
def test_unreadable_logs_are_named(log, text, message):
    log.write_text(text)
    with pytest.raises(DataError, match=rf"metrics\.csv.*{message}"):
        plot_losses(log)
    with pytest.raises(DataError, match="no training log"):
        plot_losses(log.with_name("other.csv"))


def test_outfits_are_bars_of_displayed_values():
    rows = [
        Score("t", outfit, method, "", "cd_point", value, "m^2", 1, 0, 0, 0.0, 1, "")
        for outfit, method, value in (("b", "pop", 2e-4), ("a", "pop", 1e-4), ("a", "body", 9e-4))
    ]
    (panel,) = plot_outfits(rows, "cd_point").axes
    assert [tick.get_text() for tick in panel.get_xticklabels()] == ["a", "b"]
    body, pop = panel.containers
    assert (body.get_label(), [bar.get_height() for bar in body]) == ("body", pytest.approx([9]))
    assert [bar.get_height() for bar in pop] == pytest.approx([1, 2])


def test_svg_is_inline_ready(log):
    svg = inline_svg(plot_losses(log), "one", 'Loss "terms" & <more>')
    ElementTree.fromstring(svg)  # well-formed
    assert svg.startswith("<svg viewBox=") and 'aria-label="Loss &quot;terms&quot; &amp; &lt;more&gt;"' in svg
    assert "currentColor" in svg and not re.search("http|<style|<!--", svg)
    ids = set(re.findall(r'\sid="([^"]*)"', svg))
    assert ids and all(name.startswith("one-") for name in ids)
    used = set(re.findall(r'url\(#([^)]*)\)|href="#([^"]*)"', svg))
    assert used and all((clip or link) in ids for clip, link in used)
    assert svg == inline_svg(plot_losses(log), "one", 'Loss "terms" & <more>')
