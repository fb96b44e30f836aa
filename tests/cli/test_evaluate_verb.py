"""`engram evaluate`: a drive, a result and a trajectory against files of true poses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from engram.sample.drives import write_drives
from engram.sequences.motion_files import read_tum


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluated")
    write_drives(folder)
    return folder


def kitti(tum: Path, out: Path) -> Path:
    """The poses in KITTI's format, which has no stamps."""
    poses = [pose.matrix()[:3].ravel() for pose in read_tum(tum).world_from_cam]
    out.write_text("\n".join(" ".join(map(str, row.tolist())) for row in poses))
    return out


def test_a_drive_is_judged_by_its_odometry_in_either_format(engram, drives, tmp_path) -> None:
    truth = drives / "tuesday.truth.txt"
    found = engram("evaluate", drives / "tuesday", "--truth", truth, "--json").json
    assert found["kind"] == "odometry"
    assert found["compared"] == found["poses"] == 40
    assert 0 < found["offset_m"]["rmse"] < 0.1
    assert [one["over_m"] for one in found["relative"]] == [None, 10.0]
    other = kitti(truth, tmp_path / "poses.txt")
    again = engram("evaluate", drives / "tuesday", "--truth", other, "--json").json
    assert again["offset_m"] == pytest.approx(found["offset_m"], abs=1e-7)
    text = engram("evaluate", drives / "tuesday", "--truth", truth).out
    assert f"{found['offset_m']['rmse']:.3f} m" in text
    assert "RPE over 10 m" in text


def test_a_result_is_judged_where_the_robot_took_itself_to_be(engram, drives, tmp_path) -> None:
    truth, town = drives / "tuesday.truth.txt", tmp_path / "town.engram"
    engram("map", town, drives / "monday")
    result, tum = tmp_path / "tuesday.json", tmp_path / "tuesday.tum"
    printed = engram("localise", town, drives / "tuesday", "--json", "--trajectory", tum)
    result.write_text(printed.out)
    found = engram("evaluate", result, "--truth", truth, "--json").json
    assert found["kind"] == "result"
    summary = printed.json["summary"]
    assert found["longest_gap_m"] == summary["longest_gap_m"]
    assert (share := found["share_localised"]) == summary["share_localised"]
    assert (
        f"localised {share:.1%} of the frames" in engram("evaluate", result, "--truth", truth).out
    )
    placed = [one for one in printed.json["frames"] if one["map_from_live"] is not None]
    assert found["poses"] == len(placed)
    # The map's own truth: its first node lies at the origin and looks along x.
    assert found["offset_m"]["rmse"] < 0.1
    steps_m = [one["step_m"] for one in printed.json["frames"]]
    assert sum(steps_m) == pytest.approx(printed.json["summary"]["driven_m"])
    by_file = engram("evaluate", tum, "--truth", truth, "--json").json
    assert by_file["kind"] == "trajectory"
    assert by_file["offset_m"]["rmse"] == pytest.approx(found["offset_m"]["rmse"], abs=0.02)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "0 of 40 poses have a true pose"),
        ("1 2 3\n", "line 1"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "1 poses for 40 stamps"),
        ("5 0 0 0 0 0 0 1\n6 0 0 0 0 0 0 1\n", "the truth's 5.000 to 6.000 s"),
    ],
)
def test_a_truth_that_does_not_fit_is_refused(engram, drives, tmp_path, content, says) -> None:
    truth = tmp_path / "truth.txt"
    truth.write_text(content)
    ran = engram("evaluate", drives / "tuesday", "--truth", truth)
    assert ran.status == 2
    assert says in ran.err


SUMMARY = {
    "frames": 1, "share_localised": 1.0, "statuses": {"localised": 1, "dead_reckoning": 0,
    "lost": 0}, "driven_m": 1.0, "p_no_match_10m": 0.0, "longest_gap_m": 0.0,
    "attempts_per_frame": 1.0,
}  # fmt: skip
FRAME = {"stamp_ns": 1, "status": "localised", "step_m": 1.0}


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[1, 2]",
        json.dumps({"frames": []}),
        json.dumps({"summary": SUMMARY, "frames": [{**FRAME, "status": "flying"}]}),
        json.dumps({"summary": SUMMARY, "frames": [{**FRAME, "map_from_live": [1.0]}]}),
        json.dumps({"summary": SUMMARY, "frames": [{**FRAME, "map_from_live": [0.0] * 16}]}),
        json.dumps({"summary": SUMMARY, "frames": [FRAME, FRAME]}),
        '{"summary":' + "[" * 100_000,
    ],
)
def test_a_damaged_result_is_refused(engram, drives, tmp_path, content: str) -> None:
    result = tmp_path / "result.json"
    result.write_text(content)
    ran = engram("evaluate", result, "--truth", drives / "tuesday.truth.txt")
    assert ran.status == 2
    assert ran.err.startswith("engram: ")
    assert ran.err.count("\n") == 1
