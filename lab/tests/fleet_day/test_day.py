"""A fleet's day: every fault ends with its reason, and the stages tell what they do."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from tests.centre.conftest import drive

from engram.errors import EngramError
from engram.fleet.agent.agent import MAP
from engram.fleet.agent.centre_link import enrol
from engram.fleet.centre.access import new_code
from engram.fleet.centre.fleet import robots_of
from engram.fleet.centre.service import Centre, MapPolicy
from engram.fleet.merge.merge_settings import MergeOptions
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.monitor import QUIET
from engram_lab.fleet_day.day import CuttingProxy, DayRobot, Stages, cutting, listening, run_day
from engram_lab.fleet_day.screens import chromium, take

COPY = {"select": "copy"}


class Town:
    """A centre, a link to it, and robots with small maps."""

    def __init__(self, folder: Path, centre: Centre, link: CuttingProxy) -> None:
        self.centre = centre
        self.link = link
        self._folder = folder

    def robot(self, name: str, start_ns: int) -> DayRobot:
        folder = self._folder / name
        code = new_code(self.centre, "fleet", "head", "tests")
        enrol(folder, f"http://127.0.0.1:{self.link.port}", code, name)
        drive(folder / "live" / MAP, name, start_ns, 25)
        return DayRobot(folder, self.centre, QUIET)


@pytest.fixture
def town(tmp_path: Path) -> Iterator[Town]:
    with Centre(tmp_path / "centre") as centre:
        centre.add_map("fleet", "tests", MapPolicy(merge=MergeOptions(relocaliser="none")))
        with listening(centre) as port, cutting(port, 30_000) as link:
            yield Town(tmp_path, centre, link)


@pytest.mark.long
def test_a_link_that_breaks_delays_and_loses_nothing(town: Town) -> None:
    first, second = town.robot("r1", 1_000), town.robot("r2", 2_000)
    for robot in (first, second):
        robot.hand_in("first")
    first.download(COPY)
    assert town.link.cuts >= 3
    with Map.open(first.live) as store:
        assert store.node_count() == 50
    assert not check_file(first.live).problems


def test_a_download_that_cannot_be_made_ends_at_once_with_its_reason(
    town: Town, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise EngramError("no such hour")

    monkeypatch.setattr("engram.fleet.centre.downloads.download", refuse)
    robot = town.robot("r1", 1_000)
    robot.hand_in("first")
    with pytest.raises(EngramError, match=r"r1 downloads, copy: .*no such hour"):
        robot.download(COPY)


def test_a_hand_in_that_cannot_be_merged_ends_at_once_with_its_reason(
    town: Town, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise EngramError("no such thing")

    monkeypatch.setattr("engram.fleet.centre.merge_job.admit", refuse)
    with pytest.raises(EngramError, match=r"the centre merges r1's first foray: no such thing"):
        town.robot("r1", 1_000).hand_in("first")


def test_a_link_that_never_holds_ends_with_what_the_agent_says(
    town: Town, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = town.robot("r1", 1_000)
    monkeypatch.setattr("engram_lab.fleet_day.day._ROUNDS", 5)
    town.link.close()
    with pytest.raises(EngramError, match=r"not over after 5 rounds, .* broke 5 times"):
        robot.hand_in("first")


def test_the_proxy_survives_a_server_that_is_not_there() -> None:
    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with socket.create_server(("127.0.0.1", 0)) as found:
        port = found.getsockname()[1]
    with cutting(port, 10_000) as link:
        with pytest.raises((ConnectionError, http.client.HTTPException)):
            _get(link.port)
        with HTTPServer(("127.0.0.1", port), Answer) as server:
            threading.Thread(target=server.handle_request, daemon=True).start()
            assert _get(link.port) == 204


def _get(port: int) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", "/")
        return connection.getresponse().status
    finally:
        connection.close()


def test_stages_are_told_as_they_begin_and_end() -> None:
    told: list[str] = []
    stages = Stages(QUIET, told.append)
    with stages.stage("merge", 2):
        assert told == ["merge …"]
    assert told[1].startswith("merge: ")
    assert list(stages.took) == ["merge"]


def test_pages_are_taken_of_a_copy_of_the_days_centre(town: Town, tmp_path: Path) -> None:
    pytest.importorskip("playwright.sync_api", reason="no Playwright: make test-services")
    if chromium() is None:
        pytest.skip("no Chromium on this machine")
    for name, start_ns in (("r1", 1_000), ("r2", 2_000)):
        town.robot(name, start_ns).hand_in("first")
    taken = take(tmp_path, tmp_path)
    assert [one.name for one in taken] == ["centre_map.jpg", "centre_robots.png"]
    assert min(one.stat().st_size for one in taken) > 10_000
    assert {one.follows for one in robots_of(town.centre, "fleet")} == {"head"}


@pytest.mark.long
def test_the_day_comes_to_its_end(tmp_path: Path) -> None:
    report = run_day(tmp_path / "day")
    assert [one.robot for one in report.forays] == ["r1", "r2", "r3"]
    assert report.faults == 0
    assert report.cuts > 20
    assert report.revisions >= 4
    assert all(one.received_bytes > 100_000 for one in report.forays)
    # Each has mapped half of the round: the other half is what it gains.
    gains = [one.shared.localised - one.alone.localised for one in report.forays]
    assert min(gains) > 0.2
    assert report.forays[1].shared.localised > 0.75  # in rain
    spared = [one.alone.added - one.shared.added for one in report.forays]
    assert max(spared) > 10
    assert all(one.why for one in report.forays)
