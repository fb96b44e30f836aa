"""The verbs by which a robot is found and a map's vocabulary is made."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cli.conftest import engram

__all__ = ["engram"]


@pytest.fixture
def town(mapped_street: Path, tmp_path: Path) -> Path:
    """A map of the street of the test's own."""
    return Path(shutil.copy(mapped_street, tmp_path / "town.engram"))


def test_every_frame_of_the_mapped_drive_is_found_at_once(engram, street: Path, town: Path) -> None:
    result = engram("lab", "relocalise", town, street, "--json").json
    assert result["summary"]["frames"] == result["summary"]["found"] == 12
    for frame in result["frames"]:
        assert frame["status"] == "found"
        assert frame["attempts"] <= 64
        assert frame["inliers"] >= 20
        assert 0 <= frame["new_place"] <= 1


def test_lanes_and_threads_are_as_the_settings_say(
    engram, street: Path, town: Path, tmp_path: Path, monkeypatch
) -> None:
    calls = []

    def look(*_, **options):
        calls.append((options["budget"].lanes, options["threads"]))
        return []

    monkeypatch.setattr("engram_lab.relocalising.relocalise_drive", look)
    file = tmp_path / "robot.toml"
    file.write_text("[drive]\nlanes = 3\nthreads = 4\n")
    asked = ("lab", "relocalise", town, street)
    for options in ((), ("--config", file), ("--config", file, "--set", "drive.lanes=1")):
        assert engram(*asked, *options).status == 0
    assert calls == [(2, 2), (3, 2), (1, 1)]


def test_an_empty_map_is_a_new_place_everywhere(engram, street: Path, tmp_path: Path) -> None:
    from engram.maps.map import Map

    Map.create(tmp_path / "empty.engram").close()
    summary = engram("lab", "relocalise", tmp_path / "empty.engram", street, "--json").json[
        "summary"
    ]
    assert summary["new_place"] == summary["frames"] == 12
    assert summary["attempts"] == 0


def test_an_empty_map_has_no_places_that_look_alike(engram, tmp_path: Path) -> None:
    from engram.maps.map import Map

    Map.create(tmp_path / "empty.engram").close()
    ran = engram("lab", "places", tmp_path / "empty.engram")
    assert ran.status == 0
    assert "no two distant places" in ran.out


def damage_first_node(path: Path) -> None:
    connection = sqlite3.connect(path)
    connection.execute(
        "UPDATE frames SET landmarks = CAST(substr(landmarks, 1, 99) || x'ff' || "
        "substr(landmarks, 101) AS BLOB) WHERE node = (SELECT min(node) FROM frames)"
    )
    connection.commit()
    connection.close()


@pytest.mark.parametrize("relocaliser", ["fabmap", "bag-of-words", "exhaustive"])
def test_a_damaged_node_is_passed_over_and_told(
    engram, street: Path, town: Path, relocaliser: str
) -> None:
    damage_first_node(town)
    asked = ("lab", "relocalise", town, street, "--relocaliser", relocaliser)
    ran = engram(*asked)
    assert ran.status == 0
    assert "warning: skipped 1 damaged node of the map" in ran.err
    summary = engram(*asked, "--json").json["summary"]
    assert summary["found"] > 6
    (damaged,) = summary["damaged_nodes"]
    assert damaged in engram("check", town).out


def test_a_robot_that_meets_a_damaged_node_is_localised_all_the_same(
    engram, street: Path, town: Path
) -> None:
    damage_first_node(town)
    ran = engram("localise", town, street)
    assert ran.status == 0
    assert "warning: 1 damaged node of the map was skipped" in ran.err
    found = engram("localise", town, street, "--json").json
    assert found["summary"]["share_localised"] > 0.5
    assert [node for frame in found["frames"] for node in frame["damaged"]] == (
        found["summary"]["damaged_nodes"]  # told once
    )
    mapped = engram("map", town, street, "--robot", "twin")
    assert mapped.status == 0
    assert "warning: 1 damaged node of the map was skipped" in mapped.err


def redrawn(street: Path, folder: Path, draw) -> Path:
    """The drive with other images."""
    shutil.copytree(street, folder)
    for image in sorted(folder.glob("*/*.png")):
        cv2.imwrite(str(image), draw(cv2.imread(str(image), cv2.IMREAD_GRAYSCALE)))
    return folder


def test_a_drive_elsewhere_is_known_nowhere(
    engram, street: Path, town: Path, tmp_path: Path
) -> None:
    elsewhere = redrawn(
        street, tmp_path / "elsewhere", lambda image: np.ascontiguousarray(image[::-1])
    )
    summary = engram("lab", "relocalise", town, elsewhere, "--json").json["summary"]
    assert summary["found"] == 0
    assert summary["unknown"] == 12


def test_images_without_features_are_unusable(
    engram, street: Path, town: Path, tmp_path: Path
) -> None:
    blank = redrawn(street, tmp_path / "blank", lambda image: np.full_like(image, 128))
    ran = engram("lab", "relocalise", town, blank)
    assert ran.status == 0
    assert "0 of 12 frames found" in ran.out
    assert "12 unusable" in ran.out


def test_a_vocabulary_of_another_descriptor_is_refused(
    engram, street: Path, town: Path, tmp_path: Path
) -> None:
    other = tmp_path / "net.engram"
    assert engram("map", other, street, "--features", "net").status == 0
    assert engram("vocabulary", "train", other, "--words", 100).status == 0
    ran = engram("vocabulary", "use", town, other)
    assert ran.status != 0
    assert "net@" in ran.err
    assert "brief" in ran.err
    assert engram("vocabulary", "show", town, "--json").json["default"]


def test_a_relocaliser_that_is_not_there_is_named(engram, street: Path, town: Path) -> None:
    ran = engram("lab", "relocalise", town, street, "--relocaliser", "oracle")
    assert ran.status == 2
    assert "oracle" in ran.err
    assert "fabmap" in ran.err


def test_a_trained_vocabulary_is_kept_and_used(engram, street: Path, town: Path) -> None:
    before = engram("vocabulary", "show", town, "--json").json
    assert before["default"]
    trained = engram("vocabulary", "train", town, street, "--words", 200, "--json").json
    shown = engram("vocabulary", "show", town, "--json").json
    assert not shown["default"]
    assert shown["hash"] == trained["hash"] != before["hash"]
    assert shown["words"] == 200
    assert trained["revision"] == 2
    assert engram("check", town).status == 0
    assert engram("lab", "relocalise", town, street, "--json").json["summary"]["found"] == 12
    # Readers of the revision before see the map as it was.
    assert (
        engram("lab", "relocalise", town, street, "--at", 1, "--json").json["summary"]["found"]
        == 12
    )


def test_training_twice_gives_the_same_vocabulary(engram, town: Path) -> None:
    hashes = {
        engram("vocabulary", "train", town, "--words", 100, "--json").json["hash"] for _ in "ab"
    }
    assert len(hashes) == 1


def test_too_many_words_are_refused(engram, town: Path) -> None:
    ran = engram("vocabulary", "train", town, "--words", 60000)
    assert ran.status == 2
    assert "too few for 60000 words" in ran.err
    assert engram("vocabulary", "show", town, "--json").json["default"]


def test_places_that_are_near_each_other_are_no_lookalikes(
    engram, town: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "confusion.png"
    found = engram("lab", "places", town, "--picture", picture, "--json").json
    # One street of nine metres: all of it is one place's surroundings.
    assert found["lookalikes"] == []
    assert found["nodes"] > 0
    assert cv2.imread(str(picture)).shape[0] == cv2.imread(str(picture)).shape[1]


def test_two_maps_of_one_street_look_alike(engram, street: Path, town: Path, tmp_path) -> None:
    # The same images as another robot's drive, which is not told that it is in the same street.
    again = engram("map", town, street, "--robot", "twin", "--json").json
    assert again["share_localised"] > 0.5  # it is found, so nothing is saved twice
    assert engram("lab", "places", town, "--json").json["lookalikes"] == []
