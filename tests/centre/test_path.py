"""The whole way: enrol, hand in, merge, download, switch."""

from __future__ import annotations

from engram.fleet.merge.merging import merge
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .conftest import NAME, POLICY, drive


def test_a_fleet_shares_what_it_saw_as_if_its_files_had_been_merged(tmp_path, site):
    files = []
    for number in range(3):
        agent = site.robot(f"r{number}")
        drive(agent.live, f"r{number}", 1_000 + number)
        files.append(tmp_path / f"copy{number}.engram")
        files[-1].write_bytes(agent.live.read_bytes())
        assert agent.hand_in() is not None
        assert agent.hand_in() is None
        agent.step()
        assert site.work() > 0
    merge(tmp_path / "files.engram", files, POLICY.merge)
    with Map.open(tmp_path / "files.engram") as store:
        assert site.content() == store.content_hash()
    assert check_file(site.centre.map_path(NAME)).problems == ()


def test_a_robot_without_a_map_gets_one_and_switches_when_parked(site, in_process):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    first.hand_in()
    site.settle()
    assert not second.live.exists()
    assert second.switch()
    assert second.state.facts.runs.startswith("1-")
    with Map.open(second.live) as ours, Map.open(first.live) as theirs:
        assert ours.load().nodes == theirs.load().nodes
    drive(second.live, "r2", 5_000)
    second.hand_in()
    before = second.link.sent_bytes
    site.settle()
    assert second.link.sent_bytes - before < 40_000
    assert first.switch()
    for one in (site.centre.map_path(NAME), first.live, second.live):
        assert check_file(one).problems == ()
    for one in (site.centre.map_path(NAME), first.live):
        with Map.open(one) as store:
            assert {drive.robot for drive in store.sessions.values()} == {"r1", "r2"}
