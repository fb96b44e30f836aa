"""Pictures of matches: both images whole, named, in the size of the live one."""

from __future__ import annotations

import numpy as np
import pytest

from engram.viewing.pictures import match_picture


@pytest.mark.parametrize(
    ("size", "shape"), [((100, 300), (100 + 8 + 100 + 28, 300, 3)), ((100, 120), (128, 248, 3))]
)
def test_wide_images_lie_above_each_other_and_others_side_by_side(
    size: tuple[int, int], shape: tuple[int, int, int]
) -> None:
    live = np.full(size, 90, np.uint8)
    node = np.full((20, 40), 40, np.uint8)
    none = np.zeros((0, 2), np.float32)
    picture = match_picture(node, live, none, none, "lost")
    assert picture.shape == shape
    assert (picture[size[0] // 2, 60] == 40).all()
    assert (picture[shape[0] - 28 - size[0] // 2, -10] == 90).all()


def test_every_inlier_is_a_point_and_few_are_joined() -> None:
    live = np.zeros((400, 300), np.uint8)
    rows, columns = np.mgrid[30:390:20, 60:290:20]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float32)
    picture = match_picture(live, live, pixels / (300, 400), pixels, "")
    centres = picture[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    assert (centres.max(axis=1) > 100).all()
    gap = picture[40:380, 301:307].max(axis=(1, 2))
    crossings = np.count_nonzero(np.diff((gap > 50).astype(int)) == 1)
    assert 1 <= crossings <= 12
