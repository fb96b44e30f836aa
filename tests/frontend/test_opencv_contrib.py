"""Without OpenCV's contrib modules all but one kind of features works, and that one says so."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from tests.cli.conftest import engram  # noqa: F401
from tests.core.textures import texture

from engram.frontend.features import FEATURES
from engram_lab.bench.data import BenchData, synthetic_drive
from engram_lab.bench.runner import run_bench
from engram_lab.teblid import TEBLID

CURE = "pip install --force-reinstall --no-deps opencv-contrib-python-headless"


@pytest.fixture(params=["absent", "emptied by another wheel"], autouse=True)
def _no_contrib(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What `cv2.xfeatures2d` is without them, alone or over a wheel that has them."""
    monkeypatch.delattr(cv2, "xfeatures2d", raising=False)
    if request.param != "absent":
        monkeypatch.setattr(cv2, "xfeatures2d", ModuleType("cv2.xfeatures2d"), raising=False)


@pytest.mark.parametrize("kind", sorted(FEATURES.keys() - {TEBLID}))
def test_other_kinds_need_none(kind: str) -> None:
    pixels = np.array([[60, 60]], np.float32)
    described = FEATURES[kind].describe(texture(120, 120, seed=1), pixels, np.zeros(1, np.uint8))
    assert described.any()


def test_a_map_of_teblid_is_refused_with_the_cure(
    engram,  # noqa: F811
    street: Path,
    tmp_path: Path,
) -> None:
    ran = engram("map", tmp_path / "t.engram", street, "--features", "teblid")
    assert ran.status != 0
    told = " ".join(ran.err.split())
    assert told.startswith("engram: the feature kind teblid needs cv2.xfeatures2d, which")
    assert told.endswith(CURE)
    assert not (tmp_path / "t.engram").exists()


def test_the_bench_goes_on_without_its_reference() -> None:
    data = BenchData("street", synthetic_drive(frames=4, step_m=0.8))
    stage = run_bench(["attempt_512"], repeats=1, data=data).stages[0]
    assert stage.ours.ms > 0
    assert stage.reference is None
    assert stage.note.startswith("no reference: the plain pipeline needs cv2.xfeatures2d")
    assert CURE in stage.note
