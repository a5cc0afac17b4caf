"""Reports: what they say, what they escape, and how a real browser shows them."""

import base64
import io
import re
from html import unescape

import numpy as np
import pytest
from PIL import Image

from avatar.checks import AvatarError, DataError
from avatar.evaluation.metrics import METRICS
from avatar.evaluation.report import COLUMNS, Picture, PictureRow, ReportContent, picture_source, write_report
from avatar.evaluation.scores import Score
from avatar.evaluation.tables import metric_table, outfit_table

LOG = "split,step,epoch,seconds,total\ntrain,1,0,0.1,4\nvalidation,1,0,0.2,5\ntrain,2,0,0.3,3\n"
HOSTILE = "<script>alert('x')</script> & \"quotes\""


def picture(seed, alt="a picture", caption=""):
    image = np.random.default_rng(seed).integers(0, 255, size=(48, 32, 3), dtype=np.uint8)
    return Picture(image, alt, caption)


def full_content(folder, text="the text"):
    (folder / "metrics.csv").write_text(LOG)
    (folder / "meshes").mkdir()
    (folder / "meshes" / "a b&c.ply").write_bytes(b"ply")
    rows = [
        Score("t", "dress", method, "", "cd_point", value, "m^2", 20, 0, 0, 0.0, 100, "c")
        for method, value in (("sampling", 1e-4), ("body", 9e-4), (text, 2.5e-4))
    ]
    pictures = tuple(
        PictureRow(f"{text} {pose}", tuple(picture(5 * pose + c, text, text) for c in range(len(COLUMNS))))
        for pose in range(3)
    )
    return ReportContent(
        title=text,
        subtitle=text,
        summary=f"{text}\n\nsecond paragraph",
        facts={text: text},
        config_yaml=f"method: {text}\n",
        metrics_csv=folder / "metrics.csv",
        tables=(metric_table(rows, "dress"), outfit_table(rows, "cd_point")),
        pictures=pictures,
        files=(folder / "metrics.csv", folder / "meshes", folder / "meshes" / "a b&c.ply", folder / "gone.ply"),
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_browser_shows_it_without_errors_or_requests(browser, tmp_path, scheme):
    path = write_report(tmp_path, full_content(tmp_path, HOSTILE))
    page = browser.new_page(color_scheme=scheme)
    complaints, requests = [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: (complaints.append("dialog"), dialog.dismiss()))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri(), wait_until="load")
    assert complaints == []
    assert [url for url in requests if not url.startswith("data:")] == [path.as_uri()]
    images = page.locator("img")
    assert images.count() == 3 * len(COLUMNS)
    assert page.evaluate("Promise.all([...document.images].map(i => i.decode())).then(() => true)")
    assert page.evaluate("[...document.images].every(i => i.complete && i.naturalWidth === 32)")
    for shown in (images.first, images.last, page.locator("svg").first, page.locator("svg").last):
        assert np.asarray(Image.open(io.BytesIO(shown.screenshot())).convert("L")).std() > 5
    text = page.inner_text("body")
    for part in ("Loss terms", METRICS["cd_point"].definition, "second paragraph", "gone.ply", HOSTILE):
        assert part in text or part in page.content()
    assert page.locator("script").count() == 0
    page.close()


@pytest.mark.parametrize("width", [360, 800])
def test_narrow_screens_do_not_scroll_sideways(browser, tmp_path, width):
    page = browser.new_page(viewport={"width": width, "height": 700})
    page.goto(write_report(tmp_path, full_content(tmp_path)).as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.close()


def test_everything_given_is_escaped(tmp_path):
    html = write_report(tmp_path, full_content(tmp_path, HOSTILE)).read_text()
    assert "<script" not in html
    assert unescape(html).count(HOSTILE) > 20


def test_nothing_points_outside(tmp_path):
    html = write_report(tmp_path, full_content(tmp_path)).read_text()
    assert not re.search(r"https?://|//cdn|@import", html)
    links = re.findall(r'(?:href|src)="([^"]*)"', html)
    assert [link for link in links if not link.startswith(("#", "data:"))] == [
        "metrics.csv",
        "meshes",
        "meshes/a%20b%26c.ply",
    ]


def test_ids_are_unique_and_pictures_have_alternatives(tmp_path):
    html = write_report(tmp_path, full_content(tmp_path)).read_text()
    ids = re.findall(r'\sid="([^"]*)"', html)
    assert len(ids) == len(set(ids))
    assert all('alt="the text"' in tag for tag in re.findall(r"<img[^>]*>", html))
    assert all("aria-label" in tag for tag in re.findall(r"<svg[^>]*>", html))


def test_table_and_its_definition_once(tmp_path):
    html = unescape(write_report(tmp_path, full_content(tmp_path)).read_text())
    for cell in ("<td>1.000</td>", "<td>9.000</td>", "<td>2.500</td>", "max over outfits"):
        assert cell in html
    assert html.count(METRICS["cd_point"].definition) == 1


def test_missing_parts_are_said_plainly(tmp_path):
    html = write_report(tmp_path, ReportContent("empty", metrics_csv=tmp_path / "metrics.csv")).read_text()
    for text in ("No pictures", "No predictions of this run were scored"):
        assert text in html
    assert f"No training log at {tmp_path / 'metrics.csv'}" in html
    rows = (PictureRow("pose", (picture(0), picture(1), None, None, picture(2))),)
    partial = write_report(
        tmp_path, ReportContent("partial", pictures=rows, files=(tmp_path / "gone.ply",))
    ).read_text()
    for text in ('<p class="missing">no template<', '<p class="missing">no mesh<', '<span class="missing">not there<'):
        assert text in partial


def test_the_same_content_gives_the_same_bytes(tmp_path):
    content = full_content(tmp_path)
    assert write_report(tmp_path, content).read_bytes() == write_report(tmp_path, content).read_bytes()


@pytest.mark.parametrize("channels", [3, 4])
def test_picture_source_is_the_picture(channels):
    image = np.full((20, 30, channels), 255, np.uint8)
    image[5:15, 5:25, :3] = (200, 60, 30)
    source = picture_source(image)
    data = base64.b64decode(source.removeprefix("data:image/webp;base64,"))
    decoded = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA" if channels == 4 else "RGB"))
    assert np.abs(decoded[8:12, 8:22].astype(int) - image[8:12, 8:22]).max() < 16


@pytest.mark.parametrize("image", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((0, 4, 3), np.uint8)])
def test_what_is_no_picture_is_refused(image):
    with pytest.raises(AvatarError, match="image"):
        picture_source(image)


def test_rows_must_fit_the_columns_and_logs_must_be_readable(tmp_path):
    with pytest.raises(AvatarError, match=r"expected 5 for 'pose'.*got 1"):
        write_report(tmp_path, ReportContent("x", pictures=(PictureRow("pose", (picture(0),)),)))
    (tmp_path / "metrics.csv").write_text("nonsense\n")
    with pytest.raises(DataError, match=r"metrics\.csv"):
        write_report(tmp_path, ReportContent("x", metrics_csv=tmp_path / "metrics.csv"))
