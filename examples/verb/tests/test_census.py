from pathlib import Path

import numpy as np
from typer.testing import CliRunner

import engram
from engram.cli.app import app


def test_it_counts_the_nodes_of_each_robot(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wall = rng.integers(0, 256, (240, 340), dtype=np.uint8)
    camera = engram.StereoCamera(260.0, 260.0, 160.0, 120.0, 0.2, 320, 240)
    left, right = (np.ascontiguousarray(wall[:, at : at + 320]) for at in (0, 12))
    with (
        engram.open_map(tmp_path / "town.engram", create=True) as town,
        town.robot(camera, name="r1", maps=True) as robot,
    ):
        for number in range(3):
            robot.step(engram.StereoPair(number * 100_000_000, left, right, camera))
    ran = CliRunner().invoke(app, ["census", str(tmp_path / "town.engram")])
    assert ran.output == "r1: 1 nodes\n"
