"""Which remembered attempts a centre lacks, and that none is lost or doubled on the way to it."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.builders import attempts_of

from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.graph.model import SessionId
from engram.graph.paths import Attempts
from engram.maps.map import Map

from .robots import merged, rewritten, robot_map

# Few values of each, so that attempts are often equal, or differ in one thing only.
IDENTITIES = st.tuples(
    st.integers(0, 1),  # session
    st.integers(0, 2),  # iteration
    st.sampled_from([0, 255]),  # rank
    st.sampled_from([0.5, np.inf]),  # sigma_m
    st.sampled_from([0.0, 0.01]),  # sigma_yaw_rad
    st.booleans(),  # accepted
    st.integers(0, 1),  # inliers
    st.sampled_from(["recall", "path"]),
)


def arrays_of(identities: list[tuple], nodes: int = 0) -> Attempts:
    """Attempts of these identities, told from some node; nodes and offsets do not name them."""
    columns = list(zip(*identities, strict=True)) or [()] * 8
    policies = tuple(dict.fromkeys(columns[7]))
    number = np.arange(len(identities))
    values = {
        "session": columns[0],
        "iteration": columns[1],
        "rank": columns[2],
        "sigma_m": columns[3],
        "sigma_yaw_rad": columns[4],
        "accepted": columns[5],
        "inliers": columns[6],
        "policy": [policies.index(name) for name in columns[7]],
        "reference": number + nodes,
        "node": number + nodes + 1,
        "along_m": number + nodes,
        "across_m": number - nodes,
        "yaw_rad": number * 0,
    }
    floats = {"along_m", "across_m", "yaw_rad", "sigma_m", "sigma_yaw_rad"}
    return Attempts(
        **{
            one.name: np.array(
                values[one.name],
                np.float32 if one.name in floats else bool if one.name == "accepted" else np.int64,
            )
            for one in fields(Attempts)
            if one.name != "policies"
        },
        policies=policies,
    )


@given(st.lists(IDENTITIES, max_size=12), st.lists(IDENTITIES, max_size=12))
def test_what_is_lacking_makes_the_union_of_both(made, remembered):
    found = arrays_of(made).lacking(arrays_of(remembered, nodes=5)).tolist()
    assert found == sorted(set(found))
    together = Counter(remembered) + Counter(made[at] for at in found)
    assert together == Counter(made) | Counter(remembered)


def remembered_in(path, session: SessionId) -> Counter:
    """Remembered attempts of a session between the nodes that they were made on."""
    with Map.open(path) as store:
        return Counter(attempts_of(store.load(), session))


@pytest.fixture
def robot(tmp_path, fleet):
    """A robot that drove the same street twice: the second drive attempted much."""
    path = tmp_path / "robot.engram"
    shutil.copy(fleet["same"][0], path)
    robot_map(path, np.arange(0, 24, 0.8), 0, name="r2", day=7, aside_m=-0.4)
    return path


def test_attempts_that_a_download_left_behind_are_carried_when_the_whole_map_comes(tmp_path, robot):
    with Map.open(robot) as store:
        contents = store.load()
    drive = max(contents.sessions, key=lambda one: one.start_ns).id
    near = DownloadOptions("region", near=(str(contents.nodes[0].id),), radius_m=8.0)
    download(robot, tmp_path / "part.engram", near)
    part, whole = remembered_in(tmp_path / "part.engram", drive), remembered_in(robot, drive)
    assert 0 < part.total() < whole.total()
    centre = tmp_path / "centre.engram"
    merged(centre, tmp_path / "part.engram")
    (report,) = merged(centre, robot)
    assert report.attempts == (whole - part).total()
    assert remembered_in(centre, drive) >= whole
    assert not merged(centre, robot, tmp_path / "part.engram")[0].changed


def test_attempts_alone_are_worth_a_revision(tmp_path, robot):
    centre, forgetful = tmp_path / "centre.engram", tmp_path / "forgetful.engram"
    merged(centre, rewritten(robot, forgetful))
    (report,) = merged(centre, robot)
    with Map.open(robot) as store:
        assert report.attempts == len(store.load().attempts) > 0
    assert (report.changed, report.revision, report.taken) == (True, 2, 0)
    assert f"{report.attempts} attempts carried over" in report.text()
    (again,) = merged(centre, robot)
    assert (again.changed, again.revision) == (False, None)


def test_attempts_at_a_node_that_was_taken_back_come_again_with_it_and_once(tmp_path, robot):
    centre = tmp_path / "centre.engram"
    with Map.open(robot) as store:
        _, second = (one.id for one in store.load().sessions)
    # The first drive is one revision, what the second tried at its nodes another one.
    only_first = tmp_path / "first.engram"
    download(robot, only_first, DownloadOptions(), at=1)
    merged(centre, only_first, robot)
    before = remembered_in(centre, second)
    with Map.open(centre, writes=True) as store:
        store.revert(1, author="me")
    assert remembered_in(centre, second).total() < before.total()
    (report,) = merged(centre, robot)
    assert report.taken > 0
    assert remembered_in(centre, second) == before
