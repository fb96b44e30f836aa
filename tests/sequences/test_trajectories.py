"""Trajectories: what is written is read back, and other programs read it."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import InputError, SequenceError
from engram.geometry.se3 import SE3
from engram.sequences.motion_files import Trajectory, read_tum, write_tum

from .synthetic import only_engram_errors


def some_trajectory() -> Trajectory:
    rng = np.random.default_rng(5)
    stamps_ns = np.array([-5, 0, 7, 1_403_715_273_262_142_976, 2**62], dtype=np.int64)
    return Trajectory(stamps_ns, [SE3.exp(rng.normal(size=6) * 2) for _ in stamps_ns])


def test_tum_keeps_stamps_exactly_and_poses_to_a_nanometre(tmp_path: Path) -> None:
    wanted = some_trajectory()
    write_tum(tmp_path / "a.txt", wanted, ["not globally consistent", "two\nlines"])
    found = read_tum(tmp_path / "a.txt")
    assert found.stamps_ns.tolist() == wanted.stamps_ns.tolist()
    for one, other in zip(found.world_from_cam, wanted.world_from_cam, strict=True):
        # Nine decimals are written; the quaternion's rounding turns by a few 1e-9.
        np.testing.assert_allclose(one.matrix(), other.matrix(), atol=1e-8)
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (
        (tmp_path / "a.txt").read_text().startswith("# not globally consistent\n# two\n# lines\n")
    )


def test_tum_has_the_scalar_of_the_quaternion_last(tmp_path: Path) -> None:
    quarter_turn_about_y = SE3.exp([1, 2, 3, 0, np.pi / 2, 0])
    path = tmp_path / "a.txt"
    write_tum(path, Trajectory(np.array([10**9]), [quarter_turn_about_y]))
    values = [float(text) for text in path.read_text().splitlines()[-1].split()]
    np.testing.assert_allclose(values[0], 1.0)
    np.testing.assert_allclose(values[1:4], quarter_turn_about_y.translation, atol=1e-9)
    np.testing.assert_allclose(values[4:], [0, np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-9)


def test_a_folder_that_does_not_exist_is_told(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="cannot be written"):
        write_tum(tmp_path / "nowhere" / "a.txt", some_trajectory())


@pytest.mark.parametrize(
    "text",
    [
        "1.0 1 2 3 0 0 0",
        "1.0 1 2 3 0 0 0 0",
        "x 1 2 3 0 0 0 1",
        "1.0 nan 2 3 0 0 0 1",
        "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1",
        "1.0 1 2 3 0 0 0 1 9",
    ],
)
def test_malformed_tum_is_told_with_the_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(SequenceError, match=r"a\.txt.*(line 1|increase)"):
        read_tum(path)


@given(content=st.one_of(st.binary(max_size=80), st.text(max_size=60).map(str.encode)))
def test_any_bytes_give_our_errors_or_a_trajectory(tmp_path_factory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("any") / "a.txt"
    path.write_bytes(content)
    only_engram_errors(lambda: read_tum(path))


def test_the_nearest_pose_within_the_tolerance_is_found() -> None:
    poses = [SE3.exp([x, 0, 0, 0, 0, 0]) for x in range(3)]
    trajectory = Trajectory(np.array([100, 200, 300]), poses)
    assert trajectory.at(200) is poses[1]
    assert trajectory.at(201) is None
    assert trajectory.at(251, tolerance_ns=50) is poses[2]
    assert trajectory.at(1000, tolerance_ns=50) is None
    assert trajectory.at(0, tolerance_ns=100) is poses[0]


def test_stamps_of_a_trajectory_must_increase_and_fit() -> None:
    poses = [SE3.identity()] * 2
    with pytest.raises(InputError, match="increase"):
        Trajectory(np.array([1, 1]), poses)
    with pytest.raises(InputError, match="2 poses"):
        Trajectory(np.array([1, 2, 3]), poses)


@pytest.mark.skipif(shutil.which("evo_traj") is None, reason="evo is not installed")
def test_evo_reads_what_we_write(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.txt", some_trajectory())
    result = subprocess.run(
        ["evo_traj", "tum", str(tmp_path / "a.txt")], capture_output=True, text=True, check=True
    )
    assert "5 poses" in result.stdout
