"""The sheet of a report's pictures."""

import numpy as np

from avatar.evaluation.report import Picture, PictureRow
from avatar.pipeline.reporting import picture_sheet


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
