"""What a fleet has forgotten: its centre asks for none of it, and robots forget it, too."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from engram.errors import MapLockedError
from engram.fleet.centre.tables import Event, audit
from engram.fleet.centre.worker import keep_to_cap, sweep_all
from engram.fleet.forgetting import Retention, forget
from engram.fleet.serving import node_bytes
from engram.maps.forgetting import erase_map
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .conftest import NAME, Site, drive


def starts_in(path) -> set[int]:
    """When the drives of a map, and of its nodes, began."""
    with Map.open(path) as store:
        of_nodes = {node.session for node in store.load().nodes}
        assert of_nodes == set(store.sessions)
        return {one.start_ns for one in store.sessions.values()}


def test_a_forgotten_drive_comes_back_from_no_robot(site: Site) -> None:
    robot, other = site.robot("r1"), site.robot("r2")
    drive(robot.live, "r1", 1_000)
    robot.hand_in()
    site.settle()
    centre = site.centre.map_path(NAME)
    with Map.open(centre) as store:
        (gone,) = store.sessions
    forget(centre, Retention(sessions=(str(gone),)), author="tests")
    with pytest.raises(MapLockedError):
        erase_map(centre)  # a centre keeps its maps open: it is stopped meanwhile
    site.close()
    erase_map(centre)
    site.restart()
    robot, other = site.robot("r1"), site.robot("r2")
    drive(robot.live, "r1", 2_000)
    robot.hand_in()
    site.settle()
    assert starts_in(centre) == {2_000}
    for one in (robot, other):
        one.switch()
        assert starts_in(one.live) == {2_000}
        assert check_file(one.live).problems == ()
    robot.hand_in()
    site.settle()
    assert starts_in(centre) == {2_000}
    assert check_file(centre).problems == ()


def test_a_worker_keeps_a_map_to_its_cap_and_robots_follow(site: Site) -> None:
    robot = site.robot("r1")
    for start_ns in (1_000, 2_000):
        drive(robot.live, "r1", start_ns)
        robot.hand_in()
        site.settle()
    centre = site.centre
    with Map.open(centre.map_path(NAME)) as store:
        sizes, before = node_bytes(store.sized().sizes), store.revision
    assert keep_to_cap(centre, NAME) == 0  # no cap is set
    most_bytes = int(sizes.sum()) // 2
    centre.set_policy(NAME, replace(centre.policy(NAME), cap_bytes=most_bytes), "tests")
    sweep_all(centre)
    with Map.open(centre.map_path(NAME)) as store:
        left = node_bytes(store.sized().sizes)
        assert 0 < left.sum() <= most_bytes
        assert left.sum() + sizes.max() > most_bytes  # no node too many went
        assert store.revision == before + 1
        forgot = next(entry for entry in store.log() if entry.number == store.revision)
    assert (forgot.author, forgot.message) == ("worker", "forget: the map's cap")
    (noted,) = centre.database.rows(Event, audit.c.action == "cap")
    assert json.loads(noted.detail) == {"revision": before + 1, "nodes": len(sizes) - len(left)}
    sweep_all(centre)  # what is within the cap stays as it is
    with Map.open(centre.map_path(NAME)) as store:
        assert store.revision == before + 1
    site.settle()
    assert robot.switch()
    for path in (centre.map_path(NAME), robot.live):
        with Map.open(path) as store:
            assert store.node_count() == len(left)
        assert check_file(path).problems == ()
