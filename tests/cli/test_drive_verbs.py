"""`engram drive`, and what the verbs of drives say of bags."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.sequences.bag_maker import StereoBag, bag, rectified_infos

from engram.calibration.formats import read_calibration
from engram.errors import NotAMapError
from engram.frontend.frontend import FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.maps.map import open_map
from engram.sequences.opening import open_drive


@pytest.fixture(scope="module")
def street_bag(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rendered street as a bag."""
    drive = open_drive(street)
    pairs = [(pair.stamp_ns + 10**18, pair.left, pair.right) for pair in drive]
    folder = tmp_path_factory.mktemp("bags")
    return StereoBag(pairs, rectified_infos(drive.camera)).write(folder / "street", "mcap")


def test_info_lists_topics_and_the_command_to_run(engram, street_bag: Path) -> None:
    ran = engram("drive", "info", street_bag)
    assert ran.status == 0
    line = next(one for one in ran.out.splitlines() if "/stereo/left/image_raw" in one)
    assert "12 × sensor_msgs/msg/Image" in line
    assert "10.0 Hz" in line
    assert f"next: engram map MAP.engram {street_bag}" in ran.out
    facts = engram("drive", "info", street_bag, "--json").json
    assert facts["left"] == "/stereo/left/image_raw"
    assert facts["duration_s"] == pytest.approx(1.1)


def test_info_asks_for_what_is_missing(engram, tmp_path: Path) -> None:
    with bag(tmp_path / "b", "mcap") as maker:
        for topic in ("/front/left/image_raw", "/front/right/image_raw"):
            maker.image(topic, 10**18, np.zeros((64, 64), np.uint8))
    ran = engram("drive", "info", tmp_path / "b")
    assert ran.status == 2
    assert "missing: has no CameraInfo" in ran.out
    assert "--calibration FILE" in ran.out.splitlines()[-1]


def test_info_of_a_folder(engram, street: Path) -> None:
    ran = engram("drive", "info", street)
    assert "folder, 12 pairs in 1.1 s" in ran.out


def test_names_from_a_bag_cannot_reach_the_terminal_as_commands(engram, tmp_path: Path) -> None:
    with bag(tmp_path / "b", "mcap") as maker:
        for topic in ("/\x1b]0;owned\x07left/image", "/\x1b]0;owned\x07right/image"):
            maker.image(topic, 10**18, np.zeros((64, 64), np.uint8))
    for arguments in (("drive", "info"), ("map", tmp_path / "m.engram")):
        ran = engram(*arguments, tmp_path / "b")
        assert not {"\x1b", "\x07"} & set(ran.out + ran.err)


def test_a_calibration_can_be_edited_and_given_back(engram, street_bag, tmp_path) -> None:
    ran = engram("drive", "calibration", street_bag, "--picture", tmp_path / "pair.png")
    assert ran.status == 0
    assert "baseline" in ran.out
    file = tmp_path / "calibration.toml"
    file.write_text(ran.out)
    drive = open_drive(street_bag)
    assert read_calibration(file).camera == drive.camera
    picture = cv2.imread(str(tmp_path / "pair.png"))
    assert picture.shape[1] == 2 * drive.camera.width + 4
    file.write_text(ran.out.replace("baseline_m = ", "baseline_m = 1"))
    again = open_drive(street_bag, calibration=file)
    assert again.camera.baseline_m > 1


def test_a_bag_is_mapped_and_localised_in(engram, street, street_bag, tmp_path) -> None:
    town = tmp_path / "town.engram"
    ran = engram("map", town, street_bag)
    assert ran.status == 0
    assert "12 of 12 left images paired (100.0 %)" in ran.err
    report = engram("localise", town, street, "--json").json
    assert {frame["status"] for frame in report["frames"]} == {"localised"}


def test_a_damaged_bag_is_used_and_told_by_the_exit_status(engram, street_bag, tmp_path) -> None:
    whole = next(street_bag.glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes())
    os.truncate(cut, int(cut.stat().st_size * 0.6))
    ran = engram("map", tmp_path / "town.engram", cut)
    assert ran.status == 3
    assert "parts of the bag could not be read; the rest was used:" in ran.err
    assert "nodes saved" in ran.out


def test_a_damaged_bag_that_cannot_be_mapped_says_what_was_lost(engram, tmp_path) -> None:
    rng = np.random.default_rng(0)
    pairs = [
        (10**18 + number * 10**8, *rng.integers(0, 256, (2, 120, 160), np.uint8))
        for number in range(40)
    ]
    infos = rectified_infos(StereoCamera(100.0, 100.0, 80.0, 60.0, 0.1, 160, 120))
    StereoBag(pairs, infos).write(tmp_path / "noise", "ros1")
    os.truncate(tmp_path / "noise.bag", 1_000_000)
    ran = engram("map", tmp_path / "town.engram", tmp_path / "noise.bag")
    assert ran.status == 4, ran.err
    assert "parts of the bag could not be read:" in ran.err
    assert "is cut short" in ran.err


def test_settings_that_name_other_features_than_the_map_has_are_refused(
    engram, street: Path, tmp_path: Path
) -> None:
    path, net = tmp_path / "town.engram", ("--set", "frontend.descriptor=net")
    assert engram("map", path, street, "--frames", "0:3").status == 0
    for verb in ("localise", "map"):
        ran = engram(verb, path, street, "--frames", "1:3", *net)
        assert ran.status == 2
        assert "has brief features, not net" in ran.err
        assert "frontend.descriptor" in ran.err


def test_localising_in_an_empty_map_says_that_it_is_empty(engram, street: Path, tmp_path) -> None:
    open_map(tmp_path / "new.engram", create=True).close()
    ran = engram("localise", tmp_path / "new.engram", street, "--frames", "0:2")
    assert ran.status == 0
    assert "warning: the map is empty; begin it with engram map" in ran.err


def test_frames_beyond_the_end_of_a_drive_are_named(engram, street: Path, tmp_path: Path) -> None:
    ran = engram("map", tmp_path / "town.engram", street, "--frames", "500:600")
    assert ran.status == 2
    assert "pairs is chosen, 0 to " in ran.err
    assert "change --frames" in ran.err


def test_a_recorder_that_cannot_write_is_refused_before_the_drive(
    engram, street: Path, tmp_path: Path
) -> None:
    path = tmp_path / "town.engram"
    assert engram("map", path, street, "--frames", "0:3").status == 0
    ran = engram("localise", path, street, "--frames", "0:3", "--recorder", path / "records")
    assert ran.status == 2
    assert "records cannot be a folder" in ran.err


def test_the_list_of_features_says_what_each_is_good_at(engram) -> None:
    ran = engram("features")
    assert "256 bits  night, snow, low sun, other seasons" in ran.out
    assert "--features KIND" in ran.out


def test_nothing_stays_of_a_new_map_where_a_drive_cannot_be_read(
    engram, street: Path, tmp_path: Path
) -> None:
    broken, town = tmp_path / "broken", tmp_path / "maps" / "town.engram"
    shutil.copytree(street, broken)
    town.parent.mkdir()
    first = min((broken / "left").glob("*.png"))
    first.write_bytes(first.read_bytes()[:100])
    ran = engram("map", town, broken)
    assert ran.status == 2
    assert first.name in ran.err
    assert list(town.parent.iterdir()) == []
    assert engram("map", town, broken, "--set", "drive.skip_bad=true").status == 0


def test_no_map_is_made_to_see_one_of_its_revisions(tmp_path: Path) -> None:
    with pytest.raises(NotAMapError):
        open_map(tmp_path / "town.engram", at=1, create=True)
    assert list(tmp_path.iterdir()) == []


def carried_out(engram, told: str, tmp_path: Path):
    """Runs the command behind `next:`, with the map's name filled in."""
    words = shlex.split(next(line for line in told.splitlines() if line.startswith("next: "))[6:])
    assert words[0] == "engram"
    return engram(
        *(str(tmp_path / "m.engram") if one == "MAP.engram" else one for one in words[1:])
    )


def test_the_command_of_a_drive_keeps_what_was_given(engram, street: Path, tmp_path: Path) -> None:
    drive = tmp_path / "my drive"
    shutil.copytree(street, drive)
    (drive / "calibration.toml").rename(tmp_path / "half $.toml")
    given = ("--calibration", tmp_path / "half $.toml", "--set", "drive.skip_bad=true")
    told = engram("drive", "info", drive, *given)
    assert told.status == 0, told.err
    ran = carried_out(engram, told.out, tmp_path)
    assert ran.status == 0, ran.err
    assert "12 frames: " in ran.out


def test_the_command_of_a_bag_keeps_what_was_given(engram, street_bag, tmp_path: Path) -> None:
    told = engram("drive", "info", street_bag, "--set", "drive.robot=r 2")
    assert carried_out(engram, told.out, tmp_path).status == 0
    assert (
        engram("info", tmp_path / "m.engram", "--sessions", "--json").json["session_list"][0][
            "robot"
        ]
        == "r 2"
    )


def exchanged(street: Path, folder: Path) -> Path:
    shutil.copytree(street, folder)
    (folder / "left").rename(folder / "x")
    (folder / "right").rename(folder / "left")
    (folder / "x").rename(folder / "right")
    return folder


def test_localising_exchanged_sides_points_at_the_drive(engram, street, tmp_path: Path) -> None:
    town = tmp_path / "town.engram"
    engram("map", town, street)
    found = engram("localise", town, exchanged(street, tmp_path / "wrong"))
    last = found.out.splitlines()[-1]
    assert last.startswith("next: correct the drive (sides_swapped")
    assert "--explain" not in found.out
    assert "--left, --right" in found.err


def test_a_drive_of_another_place_is_told(engram, street, tmp_path: Path) -> None:
    town, other = tmp_path / "town.engram", tmp_path / "other"
    engram("map", town, street)
    shutil.copytree(street, other)
    for file in (other / "left").iterdir():
        for side in ("left", "right"):
            image = cv2.imread(str(other / side / file.name), cv2.IMREAD_GRAYSCALE)
            # Upside down and turned about: the same pair of cameras before other things.
            cv2.imwrite(str(other / side / file.name), 255 - image[::-1])
    found = engram("localise", town, other)
    assert "nothing in this drive looks like the map" in found.out
    assert "--explain" not in found.out
    assert engram("localise", town, street).out.count("nothing in this drive") == 0


def test_a_note_on_the_calibration_is_told_once(engram, street: Path, tmp_path: Path) -> None:
    drive = open_drive(street)
    left, right = rectified_infos(drive.camera)
    p = np.array(right["p"])
    p[0, 3] *= -1
    pairs = [(pair.stamp_ns + 10**18, pair.left, pair.right) for pair in drive]
    path = StereoBag(pairs, (left, {**right, "p": p})).write(tmp_path / "b", "mcap")
    assert engram("drive", "info", path).out.count("note: the projections state") == 1
    mapped = engram("map", tmp_path / "m.engram", path)
    assert mapped.status == 0
    assert mapped.err.count("note: the projections state") == 1
    assert engram("localise", tmp_path / "m.engram", street).out.count(" 0 localised") == 0


def test_nodes_keep_the_landmarks_of_their_live_frames_where_further_ones_are_not_wanted(
    engram, street: Path, tmp_path: Path
) -> None:
    done = engram("map", tmp_path / "town.engram", street, "--set", "mapper.landmarks=0", "--json")
    assert done.status == 0, done.err
    with open_map(tmp_path / "town.engram") as town:
        nodes = [town.frames.frame(one.id) for one in town.load().nodes]
    most = FrontendConfig().landmarks_for(nodes[0].camera.width * nodes[0].camera.height)
    assert max(len(one.landmarks) for one in nodes) <= most
