"""The program as a user meets it: every verb, and what it says when something is wrong."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.opencv import needs_contrib

from engram.live.process import LiveProcess
from engram.localiser.localiser import Localiser

FRAME_KEYS = {
    "stamp_ns", "status", "node", "node_stamp_ns", "node_from_live", "inliers", "attempts",
    "confidence", "withdraws",
    "candidates", "open_loop_m", "ms", "damaged", "fixed_share", "step_m", "map_from_live",
}  # fmt: skip
STATUSES = {"localised", "dead_reckoning", "lost", "no_odometry"}


@pytest.fixture
def town(mapped_street: Path, tmp_path: Path) -> Path:
    """A map of the street of the test's own."""
    return Path(shutil.copy(mapped_street, tmp_path / "town.engram"))


def test_mapping_reports_what_it_saved(engram, street: Path, tmp_path: Path) -> None:
    report = engram("map", tmp_path / "a.engram", street, "--json").json
    assert report["frames"] == 12
    # 12 frames 0.8 m apart, a node for each metre begun.
    assert 5 <= report["nodes_saved"] <= 12
    assert report["revision"] == 1


def test_the_same_drive_again_changes_nothing(engram, street: Path, town: Path) -> None:
    before = engram("info", town, "--json").json
    again = engram("map", town, street, "--json").json
    assert again["known"]
    assert engram("info", town, "--json").json == before


def test_localise_remembers_a_drive_without_nodes(engram, street: Path, town: Path) -> None:
    before = engram("info", town, "--json").json
    ran = engram("localise", town, street, "--robot", "r2", "--remember")
    assert ran.out.splitlines()[-1] == "kept as revision 2"
    after = engram("info", town, "--json").json
    assert after["nodes"] == before["nodes"]
    assert after["path_entries"] > before["path_entries"]
    assert after["attempts"] > before["attempts"]
    again = engram("localise", town, street, "--robot", "r2", "--remember", "--json").json
    assert again["summary"]["remembered"] == {"state": "committed", "revision": None}
    assert engram("localise", town, street, "--remember", "--at", "1").status == 2


def test_localise_gives_the_documented_json(engram, street: Path, town: Path) -> None:
    result = engram("localise", town, street, "--json").json
    assert set(result) == {"map", "drive", "summary", "frames"}
    assert result["summary"]["frames"] == len(result["frames"]) == 12
    for frame in result["frames"]:
        assert set(frame) == FRAME_KEYS
        assert frame["status"] in STATUSES
        localised = frame["status"] == "localised"
        assert (frame["node_from_live"] is not None) == localised
        if localised:
            matrix = np.array(frame["node_from_live"]).reshape(4, 4)
            np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
            np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    # The very images that the map was made of.
    assert result["summary"]["share_localised"] == 1.0
    assert result["summary"]["attempts_per_frame"] <= 4


def test_budget_bounds_the_attempts(engram, street: Path, town: Path) -> None:
    budget = ("--set", "drive.lanes=1", "--set", "drive.rounds=1")
    arguments = (*budget, "--ranking", "random", "--json")
    result = engram("localise", town, street, *arguments).json
    assert all(frame["attempts"] <= 1 for frame in result["frames"])


@pytest.mark.parametrize("policy", ["distance", "path", "path-near", "random"])
def test_every_policy_localises(engram, street: Path, town: Path, policy: str) -> None:
    result = engram("localise", town, street, "--ranking", policy, "--json").json
    assert result["summary"]["share_localised"] > 0.5


def test_a_frame_log_localises_exactly_as_its_images(
    engram, street: Path, town: Path, tmp_path: Path
) -> None:
    log = tmp_path / "street.framelog"
    assert engram("record", street, log, "--json").json["frames"] == 12
    from_images = engram("localise", town, street, "--json").json["frames"]
    from_log = engram("localise", town, log, "--json").json["frames"]
    for one, other in zip(from_images, from_log, strict=True):
        assert {**one, "ms": 0} == {**other, "ms": 0}


def test_trajectory_is_tum_and_close_to_the_drive(
    engram, street: Path, town: Path, tmp_path: Path
) -> None:
    out = tmp_path / "street.tum"
    engram("localise", town, street, "--trajectory", out)
    lines = out.read_text().splitlines()
    assert "not globally consistent" in "\n".join(line for line in lines if line[0] == "#")
    rows = np.array([line.split() for line in lines if line[0] != "#"], dtype=float)
    assert rows.shape == (12, 8)
    # 11 steps of 0.8 m straight on.
    assert np.linalg.norm(rows[-1, 1:4]) == pytest.approx(8.8, rel=0.05)


def test_pictures_show_every_frame_of_a_short_drive(
    engram, street: Path, town: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "pictures"
    engram("localise", town, street, "--pictures", folder)
    assert [path.name for path in sorted(folder.iterdir())] == [
        f"{frame:06d}_localised.png" for frame in range(12)
    ]


def test_replay_in_real_time_counts_late_frames(engram, street: Path, town: Path) -> None:
    # At 2,000 Hz nothing can be in time but what waits for no one.
    ran = engram("localise", town, street, "--rate", 2000, "--json").json
    assert ran["summary"]["late_frames"] > 0
    # Without a rate there is no schedule to be late for.
    assert engram("localise", town, street, "--json").json["summary"]["late_frames"] == 0


def test_log_and_check_speak_of_a_sound_map(engram, town: Path) -> None:
    assert engram("log", town, "--json").json[0]["number"] == 1
    ran = engram("check", town, "--json")
    assert ran.status == 0
    assert ran.json["sound"]
    assert ran.json["problems"] == []


def test_check_finds_a_flipped_byte_and_ends_with_one(engram, town: Path) -> None:
    content = bytearray(town.read_bytes())
    content[len(content) // 2] ^= 0x10
    town.write_bytes(content)
    ran = engram("check", town, "--json")
    assert ran.status == 1
    assert ran.json["problems"]
    assert all(problem["fact"] for problem in ran.json["problems"])


def test_nothing_to_seal(engram, town: Path) -> None:
    assert "no session was interrupted" in engram("check", town, "--seal").out


@needs_contrib
def test_a_teblid_map_is_localised_in_with_teblid(engram, street: Path, tmp_path: Path) -> None:
    path = tmp_path / "teblid.engram"
    assert engram("map", path, street, "--features", "teblid").status == 0
    assert engram("info", path, "--json").json["descriptor"] == "teblid"
    found = engram("localise", path, street, "--json").json
    assert found["summary"]["share_localised"] == 1.0


def test_two_kinds_of_descriptor_do_not_mix(engram, street: Path, town: Path, tmp_path) -> None:
    log = tmp_path / "net.framelog"
    assert engram("record", street, log, "--features", "net").status == 0
    for verb in ("localise", "map"):
        ran = engram(verb, town, log, "--robot", "r2", "--json")
        assert ran.status == 2
        assert ran.json["error"]["kind"] == "IncompatibleError"
        assert "net@" in ran.json["error"]["message"]


def test_a_kind_of_descriptor_that_is_insisted_on_is_not_passed_over(
    engram, street: Path, town: Path, tmp_path: Path
) -> None:
    log, new = tmp_path / "brief.framelog", tmp_path / "new.engram"
    assert engram("record", street, log).status == 0
    ran = engram("map", new, log, "--features", "teblid")
    assert ran.status == 2
    assert "has brief features, not teblid" in ran.err
    assert "record it again with --features teblid" in ran.err
    assert not new.exists()
    ran = engram("map", town, street, "--robot", "r2", "--features", "teblid", "--json")
    assert ran.json["error"]["kind"] == "ConfigError"
    assert "map the drive into another map" in ran.json["error"]["message"]
    assert engram("map", new, log, "--features", "brief").status == 0


def test_settings_come_from_toml_and_are_kept(engram, street: Path, tmp_path: Path) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text("[mapper]\nsave_every_m = 2.0\n")
    sparse = engram("map", tmp_path / "b.engram", street, "--config", settings, "--json").json
    dense = engram("map", tmp_path / "c.engram", street, "--json").json
    assert sparse["nodes_saved"] < dense["nodes_saved"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("localise", "absent.engram", "STREET"), "absent.engram"),
        (("localise", "TOWN", "nowhere"), "nowhere"),
        (("localise", "TOWN", "STREET", "--ranking", "best"), "known: "),
        (("localise", "TOWN", "STREET", "--set", "drive.relocaliser=gps"), "known: "),
        (("localise", "TOWN", "STREET", "--at", 7), "not 7"),
        (("localise", "TOWN", "STREET", "--frames", "1:x"), "1:x"),
        (("localise", "TOWN", "STREET", "--config", "CALIBRATION"), "unknown setting"),
        (("localise", "CALIBRATION", "STREET"), "calibration.toml"),
        (("map", "CALIBRATION", "STREET"), "calibration.toml"),
        (("map", "no/such/folder/a.engram", "STREET"), "no/such/folder"),
        (("map", "TOWN", "STREET", "--recorded-at", "yesterday"), "yesterday"),
        (("map", "TOWN", "STREET", "--set", "drive.longitude_deg=400"), "400"),
        (("record", "STREET", "no/such/folder/a.framelog"), "no/such/folder"),
        (("info", "STREET"), "street"),
        (("map", "TOWN", "STREET", "--features", "sift"), "sift"),
    ],
)
def test_bad_input_is_one_clear_line_and_status_two(
    engram, street: Path, town: Path, arguments: tuple[object, ...], says: str
) -> None:
    places = {"TOWN": town, "STREET": street, "CALIBRATION": street / "calibration.toml"}
    ran = engram(*(places.get(one, one) for one in arguments))
    assert ran.status == 2
    assert ran.err.startswith("engram: ")
    assert says in ran.err
    assert "Traceback" not in ran.err


def test_errors_are_json_where_json_was_asked_for(engram, street: Path) -> None:
    ran = engram("localise", "absent.engram", street, "--json")
    assert ran.status == 2
    assert ran.json["error"]["kind"] == "NotAMapError"
    assert "absent.engram" in ran.json["error"]["message"]


def test_a_bad_image_stops_the_drive_or_is_skipped_and_counted(
    engram, street: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(street, broken)
    (broken / "left" / "000005.png").write_bytes(b"no image at all")
    ran = engram("map", tmp_path / "a.engram", broken)
    assert ran.status == 2
    assert "000005.png" in ran.err
    report = engram(
        "map", tmp_path / "b.engram", broken, "--set", "drive.skip_bad=true", "--json"
    ).json
    assert report["skipped_pairs"] == 1
    assert report["frames"] == 11


def test_a_second_writer_is_told_who_writes(engram, street: Path, town: Path) -> None:
    holder = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys; from engram.maps.map import Map\n"
            f"with Map.open({str(town)!r}, writes=True):\n"
            "    print('open', flush=True); sys.stdin.read()",
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"open\n"
    try:
        ran = engram("map", town, street, "--robot", "other", "--json")
        assert ran.status == 2
        assert ran.json["error"]["kind"] == "MapLockedError"
        assert str(holder.pid) in ran.json["error"]["message"]
        # Reading goes on meanwhile.
        assert engram("localise", town, street, "--json").json["summary"]["frames"] == 12
    finally:
        holder.communicate()


@pytest.mark.parametrize("frames", [0, 3])
def test_ctrl_c_keeps_what_was_localised_and_ends_with_130(
    engram, street: Path, town: Path, monkeypatch: pytest.MonkeyPatch, frames: int
) -> None:
    localise = Localiser.localise
    seen = 0

    def interrupted(*arguments, **options):
        nonlocal seen
        seen += 1
        if seen > frames:
            raise KeyboardInterrupt
        return localise(*arguments, **options)

    monkeypatch.setattr(Localiser, "localise", interrupted)
    ran = engram("localise", town, street, "--json")
    assert ran.status == 130
    assert ran.json["summary"]["interrupted"]
    assert ran.json["summary"]["frames"] == len(ran.json["frames"]) == frames


def test_ctrl_c_at_a_live_process_says_where_the_drive_is_kept(
    engram, street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take, taken = LiveProcess._take, []

    def interrupted(*arguments):
        taken.append(take(*arguments))
        if len(taken) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(LiveProcess, "_take", interrupted)
    ran = engram("live", tmp_path / "town.engram", "--play", street, "--map")
    assert (ran.status, ran.err) == (130, "engram: interrupted; kept as revision 1\n")


def test_ctrl_c_before_there_is_a_result_is_said_in_json_too(
    engram, town: Path, street: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("engram.sequences.opening.open_with", interrupted)
    ran = engram("localise", town, street, "--json")
    assert ran.status == 130
    assert "interrupted" in ran.json["error"]["message"]


@pytest.mark.parametrize(
    ("table", "setting"),
    [
        ("mapper", "checkpoint_every = 0"),
        ("mapper", "save_every_m = nan"),
        ("localiser", "search_radius_m = -1.0"),
        ("localiser.acceptance", "min_inliers = -5"),
    ],
)
def test_settings_out_of_range_are_refused(
    engram, street: Path, tmp_path: Path, table: str, setting: str
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(f"[{table}]\n{setting}\n")
    ran = engram("map", tmp_path / "a.engram", street, "--config", settings)
    assert ran.status == 2
    assert setting.split(maxsplit=1)[0] in ran.err
    assert not (tmp_path / "a.engram").exists()


@pytest.mark.parametrize("mistyped", [("info",), ("infos", "m"), ("info", "m", "--frames", "3")])
def test_a_mistyped_command_line_is_json_for_machines_and_help_for_people(engram, mistyped) -> None:
    ran = engram(*mistyped, "--json")
    assert ran.status == 2
    assert ran.json["error"]["message"] in ran.err
    assert "Usage: engram" in ran.err
