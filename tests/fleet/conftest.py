"""Maps that several tests hand in; nobody writes to them."""

from __future__ import annotations

import numpy as np
import pytest

from .robots import robot_map


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
