import json
from collections.abc import Sequence
from pathlib import Path

import cv2
from engram_shots import SHOTS

from engram.frontend import StereoPair
from engram.sequences import layout_named
from engram.testing import check_reader, unmet


def write_shots(folder: Path, pairs: Sequence[StereoPair]) -> Path:
    for pair in pairs:
        cv2.imwrite(str(folder / f"{pair.stamp_ns}-left.png"), pair.left)
        cv2.imwrite(str(folder / f"{pair.stamp_ns}-right.png"), pair.right)
    names = ("fx", "fy", "cx", "cy", "baseline_m", "width", "height")
    camera = {name: getattr(pairs[0].camera, name) for name in names}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_it_meets_the_contract() -> None:
    assert unmet(check_reader("shots", SHOTS, write_shots)) == []


def test_engram_finds_it() -> None:
    assert layout_named("shots") is SHOTS
