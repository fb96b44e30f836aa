"""Maps that several tests hand in; nobody writes to them."""

from __future__ import annotations

import numpy as np
import pytest

from .robots import frame_log, robot_map


@pytest.fixture(scope="package")
def fleet(tmp_path_factory):
    """`first` saw 0–24 m; `same` 0–24 m alike; `longer` 12–40 m alike; `other` 0–24 m unlike.

    Each is (path, what mapping came to).
    """
    folder = tmp_path_factory.mktemp("fleet")
    near, far = np.arange(0, 24, 0.8), np.arange(12, 40, 0.8)
    return {
        "first": made(folder / "first.engram", near, 0, name="r1", day=1),
        "same": made(folder / "same.engram", near, 0, name="r2", day=2, aside_m=0.3),
        "longer": made(folder / "longer.engram", far, 0, name="r3", day=3, aside_m=-0.2),
        "other": made(folder / "other.engram", near, 1, name="r4", day=4),
    }


def made(path, places_m, appearance, **about):
    return path, robot_map(path, places_m, appearance, **about)


@pytest.fixture(scope="package")
def logs(tmp_path_factory):
    """Three drives by day, one of which sees another look; and two that are in no map."""
    folder = tmp_path_factory.mktemp("logs")
    near, far = np.arange(0, 16, 0.8), np.arange(8, 24, 0.8)
    return {
        "a": str(frame_log(folder / "a.framelog", near, 0, day=1)),
        "b": str(frame_log(folder / "b.framelog", far, 0, day=2, aside_m=0.2)),
        "c": str(frame_log(folder / "c.framelog", near, 1, day=3)),
        "held-out": str(frame_log(folder / "held-out.framelog", far, 0, day=9, aside_m=-0.2)),
        "other": str(frame_log(folder / "other.framelog", near, 1, day=8, aside_m=0.2)),
    }
