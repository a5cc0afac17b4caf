"""A report's scores of every split, and the sheet of its pictures."""

import re

import numpy as np

from avatar.evaluation.report import Picture, PictureRow
from avatar.evaluation.scoring import ScoreConfig
from avatar.pipeline.outcomes import find_ending
from avatar.pipeline.reporting import ReportConfig, picture_sheet, report
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict


def picture(shade: int) -> Picture:
    return Picture(np.full((40, 30, 3), shade, np.uint8), "a shade")


def test_a_sheet_has_no_column_of_nothing():
    """A method without garment template is shown without a column for it; one gap leaves the column."""
    full, gap = (picture(10), picture(20), None, picture(40), picture(50)), (picture(10), None, None, None, None)
    sheet = picture_sheet([PictureRow("one", full), PictureRow("two", gap), PictureRow("at rest", (None,) * 5)])
    with_template = picture_sheet([PictureRow("one", full[:2] + (picture(30),) + full[3:]), PictureRow("two", gap)])
    assert sheet.shape[0] == with_template.shape[0] and sheet.shape[1] < with_template.shape[1]
    shades = [set(np.unique(image)) for image in (sheet, with_template)]
    assert {10, 20, 40} <= shades[0] and 30 not in shades[0] and 30 in shades[1]
    assert 50 not in shades[0] | shades[1]  # the error map is not on the sheet


def test_the_page_has_the_scores_of_every_split_test_first(run, capsys):
    score = ScoreConfig(scan_points=300, metrics=["cd_point", "normal_l1"])
    for split in ("train", "test"):
        predict(PredictConfig(run=run, split=split, points=1500, device="cpu"))
        config = EvaluateConfig(runs=(run,), split=split, score=score)
        scores = evaluate(config)
        _, (following,) = find_ending("evaluate", config, scores)
        assert ("split=train" in following) == (split == "train")
    page = report(ReportConfig(run=run, split="train", frames=1)).read_text()
    titles = re.findall(r"<h3>([^<]*)</h3>", page)
    outfit = run.parent.name
    excess = "cd_point, excess (1e-4 m²)"
    assert titles == [outfit, excess, f"{outfit} (train)", excess, "Definitions"]
    assert page.count('<th scope="col">sampling</th>') == 4 and "of those trained on" in page
    assert f"cd_point, closet, {outfit}<" in page and f"cd_point, closet, {outfit} (train)<" not in page  # on top
    capsys.readouterr()
