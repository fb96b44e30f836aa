"""What a fleet has forgotten: its centre asks for none of it, and robots forget it, too."""

from __future__ import annotations

import pytest

from engram.errors import MapLockedError
from engram.fleet.forgetting import Retention, forget
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
