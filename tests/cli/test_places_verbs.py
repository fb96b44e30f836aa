"""The verbs by which a robot is found and a map's vocabulary is made."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest


@pytest.fixture
def town(engram, street: Path, tmp_path: Path) -> Path:
    path = tmp_path / "town.engram"
    assert engram("map", path, street).status == 0
    return path


def test_every_frame_of_the_mapped_drive_is_found_at_once(engram, street: Path, town: Path) -> None:
    result = engram("relocalise", town, street, "--json").json
    assert result["summary"]["frames"] == result["summary"]["found"] == 12
    for frame in result["frames"]:
        assert frame["status"] == "found"
        assert frame["attempts"] <= 4
        assert frame["inliers"] >= 20
        assert 0 <= frame["new_place"] <= 1


def test_an_empty_map_is_a_new_place_everywhere(engram, street: Path, tmp_path: Path) -> None:
    from engram.store import MapStore

    MapStore.create(tmp_path / "empty.engram").close()
    summary = engram("relocalise", tmp_path / "empty.engram", street, "--json").json["summary"]
    assert summary["new_place"] == summary["frames"] == 12
    assert summary["attempts"] == 0


def test_a_relocaliser_that_is_not_there_is_named(engram, street: Path, town: Path) -> None:
    ran = engram("relocalise", town, street, "--relocaliser", "oracle")
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
    assert engram("relocalise", town, street, "--json").json["summary"]["found"] == 12
    # Readers of the revision before see the map as it was.
    assert engram("relocalise", town, street, "--at", 1, "--json").json["summary"]["found"] == 12


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
    found = engram("places", town, "--picture", picture, "--json").json
    # One street of nine metres: all of it is one place's surroundings.
    assert found["lookalikes"] == []
    assert found["nodes"] > 0
    assert cv2.imread(str(picture)).shape[0] == cv2.imread(str(picture)).shape[1]


def test_two_maps_of_one_street_look_alike(engram, street: Path, town: Path, tmp_path) -> None:
    # The same images as another robot's drive, which is not told that it is in the same street.
    again = engram("map", town, street, "--robot", "twin", "--json").json
    assert again["share_localised"] > 0.5  # it is found, so nothing is saved twice
    assert engram("places", town, "--json").json["lookalikes"] == []
