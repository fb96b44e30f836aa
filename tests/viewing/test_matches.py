"""Pictures of matches: both images whole, named, in the size of the live one."""

from __future__ import annotations

import numpy as np
import pytest

from engram.viewing.pictures import match_picture, with_caption


@pytest.mark.parametrize(
    ("size", "shape"), [((100, 300), (100 + 8 + 100, 300, 3)), ((100, 120), (100, 248, 3))]
)
def test_wide_images_lie_above_each_other_and_others_side_by_side(
    size: tuple[int, int], shape: tuple[int, int, int]
) -> None:
    live = np.full(size, 90, np.uint8)
    node = np.full((20, 40), 40, np.uint8)
    none = np.zeros((0, 2), np.float32)
    picture = match_picture(node, live, none, none, ("map", "drive"))
    assert picture.shape == shape
    assert (picture[size[0] // 2, 60] == 40).all()
    assert (picture[shape[0] - size[0] // 2, -10] == 90).all()


def test_every_inlier_is_a_point_and_few_are_joined() -> None:
    live = np.zeros((400, 300), np.uint8)
    rows, columns = np.mgrid[30:390:20, 60:290:20]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float32)
    picture = match_picture(live, live, pixels / (300, 400), pixels, ("", ""))
    centres = picture[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    assert (centres.max(axis=1) > 100).all()
    gap = picture[40:380, 301:307].max(axis=(1, 2))
    crossings = np.count_nonzero(np.diff((gap > 50).astype(int)) == 1)
    assert 1 <= crossings <= 12


def test_a_small_live_image_is_enlarged_with_its_points() -> None:
    node, live = np.zeros((200, 240), np.uint8), np.zeros((50, 60), np.uint8)
    pixel = np.array([[30.0, 25.0]], np.float32)
    picture = match_picture(node, live, pixel / (60, 50), pixel, ("", ""))
    assert picture.shape == (200, 240 + 8 + 240, 3)
    assert picture[100, 120].max() > 100
    assert picture[100, 240 + 8 + 120].max() > 100


def test_a_long_caption_takes_several_lines() -> None:
    picture = np.zeros((40, 200, 3), np.uint8)
    short, long = (with_caption(picture, "turned 5° → " * count) for count in (1, 8))
    assert short.shape[1] == long.shape[1] == 200
    assert long.shape[0] > short.shape[0] > 40
