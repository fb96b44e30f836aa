"""The agent: offline first, patient, careful with maps."""

from __future__ import annotations

import re
from pathlib import Path

import httpx
import pytest
from tests.centre.conftest import Site, admit_here, drive

from engram.cli.options import PartlyDoneError
from engram.config import load_toml
from engram.errors import ConfigError, IncompatibleError, InputError, MapError, StorageFullError
from engram.fleet.agent.agent import Agent
from engram.fleet.agent.agent_state import AgentSettings, AgentState
from engram.fleet.agent.centre_link import CentreRefusedError, Unreachable, enrol
from engram.fleet.centre import handins, jobs, merge_job
from engram.fleet.centre.fleet import robots_of
from engram.fleet.centre.problems import UnknownError
from engram.fleet.centre.serving import back_up
from engram.fleet.centre.tables import HandIn
from engram.fleet.cli.agent_verbs import _open, _status_lines, sync
from engram.fleet.transfers import SHORT, Manifest, PartHash, encode_manifest, part_hash
from engram.maps.map import Map


@pytest.fixture
def site(tmp_path, monkeypatch):
    monkeypatch.setattr(merge_job, "admit", admit_here)
    found = Site(tmp_path)
    yield found
    found.close()


def test_pauses_grow_while_the_link_is_down_and_end_with_it(site):
    agent = site.robot("r1")
    site.link.fates = ["lost"] * 12
    pauses = [agent.step() for _ in range(12)]
    assert pauses[:4] == [1.0, 2.0, 4.0, 8.0]  # half of each: the jitter of this test is none
    assert max(pauses) == agent.settings.longest_retry_s / 2
    assert agent.step() == agent.settings.idle_s
    assert agent.status()["failures"] == 0


def test_a_folder_is_never_enrolled_with_a_second_centre(site):
    agent = site.robot("r1")
    with pytest.raises(InputError, match=r"belongs to the robot 'r1' of http://centre; give an"):
        enrol(agent.folder, "http://other", "code", "r1", site.http)


def test_a_full_outbox_keeps_the_map_and_says_so(site):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    with Agent(agent.folder, AgentSettings(outbox_bytes=1_000), client=site.link) as small:
        with pytest.raises(StorageFullError, match="outbox"):
            small.hand_in()
        assert small.status()["outbox"] == []
    assert agent.hand_in() is not None


def test_the_cap_of_the_link_is_kept_by_waiting(site):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000, 20)
    waited = []
    options = AgentSettings(bytes_per_s=10_000.0)
    with Agent(agent.folder, options, client=site.http, wait=waited.append) as capped:
        capped.hand_in()
        capped.step()
        assert sum(waited) == pytest.approx(capped.link.sent_bytes / 10_000, rel=0.4)


def test_a_hand_in_is_kept_until_a_backup_holds_it(site, tmp_path):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    site.settle()
    assert [row["state"] for row in agent.status()["outbox"]] == ["settled"]
    back_up(site.centre, tmp_path / "backup")
    site.settle()
    assert agent.status()["outbox"] == []


def test_a_new_map_that_does_not_localise_gives_way_to_the_last_one(site):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    drive(second.live, "r2", 2_000)
    first.hand_in()
    second.hand_in()
    site.settle()
    with Map.open(second.live) as store:
        before = store.content_hash()
    assert second.switch()
    assert not second.drove(0.05, 10.0)  # too early to say
    assert second.drove(0.05, 100.0)
    with Map.open(second.live) as store:
        assert store.content_hash() == before
    site.settle()
    assert second.status()["staged"] is None  # the version that did not serve is not fetched again


def test_a_map_that_serves_stays(site):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    first.hand_in()
    site.settle()
    second.switch()
    assert not second.drove(0.9, 100.0)
    assert not second.drove(0.0, 100.0)  # later it is the weather


def test_a_drive_between_fetching_and_parking_is_not_lost(site):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    drive(second.live, "r2", 2_000)
    first.hand_in()
    site.settle()
    drive(second.live, "r2", 3_000)
    assert not second.switch()
    site.settle()
    assert second.switch()
    with Map.open(second.live) as store:
        assert {one.start_ns for one in store.sessions.values()} == {1_000, 2_000, 3_000}


def test_a_folder_that_is_not_enrolled_is_named(tmp_path):
    with pytest.raises(InputError, match="engram agent enrol"):
        Agent(tmp_path)


def test_a_hand_in_of_more_parts_than_one_answer_names_is_sent_whole(site, monkeypatch):
    monkeypatch.setattr("engram.fleet.centre.transfer_routes._WANTED_AT_ONCE", 3)
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000, 10)
    agent.hand_in()
    site.settle()
    assert [row["state"] for row in agent.status()["outbox"]] == ["settled"]
    with Map.open(site.centre.map_path("fleet")) as store:
        assert store.node_count() == 10


def test_a_download_of_more_parts_than_one_request_names_is_fetched_whole(site, monkeypatch):
    monkeypatch.setattr("engram.fleet.agent.fetching._REQUESTED_AT_ONCE", 3)
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000, 10)
    first.hand_in()
    site.settle()
    assert second.switch()
    with Map.open(second.live) as store:
        assert store.node_count() == 10


def test_a_robot_without_a_mission_hands_in_and_fetches_nothing(site):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    first.hand_in()
    for agent in (first, second):
        agent.step(fetch=False)
    site.work()
    second.step(fetch=False)
    assert second.status()["staged"] is None
    assert site.work() == 0  # no download was asked for
    site.settle()
    assert second.status()["staged"] is not None


def test_what_the_centre_cannot_make_is_told_apart_from_a_broken_link(site):
    agent = site.robot("r1")
    site.link.fates = ["lost"]
    agent.step()
    assert isinstance(agent.trouble, Unreachable)
    agent.step()
    assert agent.trouble is None
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    site.settle()
    with Agent(agent.folder, AgentSettings(download={"nothing": 1}), client=site.link) as wrong:
        wrong.state.remember(staged=None)
        wrong.step()
        assert isinstance(wrong.trouble, CentreRefusedError)


def test_settings_of_an_agent_are_read_from_a_file():
    text = "bytes_per_s = 250000\n[download]\nselect = 'budget'\nbudget_bytes = 1\n"
    read = load_toml(text, AgentSettings)
    assert (read.bytes_per_s, read.download["select"]) == (250_000.0, "budget")
    for wrong in (
        lambda: load_toml("bytes_per_s = -1", AgentSettings),
        lambda: AgentSettings(bytes_per_s=-1.0),
    ):
        with pytest.raises(ConfigError, match="bytes_per_s"):
            wrong()


def test_a_robot_whose_disk_is_full_says_so_and_goes_on(site):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000, 20)
    pages = agent.state._connection.execute("PRAGMA page_count").fetchone()[0]
    agent.state._connection.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StorageFullError, match=r"agent\.sqlite cannot grow"):
        agent.hand_in()
    assert agent.step() > 0
    agent.state._connection.execute("PRAGMA max_page_count = 100000")
    assert agent.hand_in() is not None
    site.settle()
    assert [row["state"] for row in agent.status()["outbox"]] == ["settled"]


def test_what_does_not_fit_the_robots_map_is_trouble_and_is_fetched_once(site, monkeypatch):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    drive(second.live, "r2", 2_000)
    first.hand_in()
    for _ in range(2):
        first.step()
        second.step()
        site.work()

    def unfit(*_):
        raise IncompatibleError("net does not fit brief")

    monkeypatch.setattr(Agent, "_stage", unfit)
    assert second.step() > 0
    assert str(second.trouble) == second.status()["trouble"] == "net does not fit brief"
    received = second.link.received_bytes
    second.step()
    assert second.link.received_bytes - received < 1_000
    monkeypatch.undo()
    second.step()
    assert second.trouble is None
    assert second.status()["staged"] is not None
    assert [one.name for one in (second.folder / "next").glob("*.engram")] == ["map.engram"]


def test_a_hand_in_that_is_no_map_is_not_sent_again_and_holds_up_nothing(site):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    page = part_hash(b"no page")
    manifest = encode_manifest(Manifest("00" * 16, 1, {"nodes": (page,)}))
    agent.state.queue("bad", manifest, {page: b"no page"})
    agent.hand_in()
    site.settle()
    bad, good = agent.status()["outbox"]
    assert (bad["state"], good["state"]) == ("failed", "settled")
    assert "(422)" in bad["error"]
    sent = agent.link.sent_bytes
    agent.step()
    assert agent.link.sent_bytes - sent < 400  # its report alone


def test_what_the_centre_did_not_take_makes_room_in_a_full_outbox(site):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    agent.state.queue("bad", b"{}", {PartHash(b"x" * 32): bytes(100_000)})
    agent.state.set_outbox("bad", "failed", None, "no map")
    limits = AgentSettings(outbox_bytes=100_000)
    with Agent(agent.folder, limits, client=site.link) as small:
        assert small.hand_in() is not None
        assert [row["state"] for row in small.status()["outbox"]] == ["queued"]


def test_a_login_page_on_the_way_is_no_centre(tmp_path):
    page = httpx.MockTransport(lambda _: httpx.Response(200, text="<html>Log in"))
    client = httpx.Client(transport=page, base_url="http://wifi")
    with pytest.raises(Unreachable, match="no centre answers at http://wifi/v1/robots/enrol"):
        enrol(tmp_path, "http://wifi", "code", "r1", client)


def test_a_certificate_that_is_not_trusted_names_what_can_be_done(tmp_path):
    def refuse(_):
        raise httpx.ConnectError("[SSL: CERTIFICATE_VERIFY_FAILED] self-signed certificate")

    client = httpx.Client(transport=httpx.MockTransport(refuse), base_url="https://town")
    with pytest.raises(Unreachable, match="SSL_CERT_FILE can name"):
        enrol(tmp_path, "https://town", "code", "r1", client)


def test_an_agent_that_runs_tells_what_it_does(site, caplog):
    caplog.set_level("INFO", "engram.fleet.agent")
    first, second = site.robot("r1"), site.robot("r2")
    first.introduce()
    site.link.fates = ["lost"]
    first.step()
    drive(first.live, "r1", 1_000)
    key = first.hand_in()[:SHORT]
    site.settle()
    assert second.switch()
    told = [record.getMessage() for record in caplog.records if "engram.fleet.agent" in record.name]
    assert told[0] == "robot r1 of map fleet at http://centre: runs version none, outbox 0"
    assert told[1] == "the centre cannot be reached: ConnectError('lost'); tried again in 1 s"
    assert told[2:4] == [f"hand-in {key}: sending", f"hand-in {key}: sent"]
    assert f"hand-in {key}: settled, in revision 1" in told
    version = second.status()["runs"]
    assert f"version {version} is ready: the robot takes it when it is parked" in told


def test_a_hand_in_has_one_id_on_both_sides(site):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    key = agent.hand_in()
    site.settle()
    (row,) = handins.listed(site.centre, "fleet")
    assert row.id == key == agent.status()["outbox"][0]["id"]
    assert [robot.report["outbox"] for robot in robots_of(site.centre, "fleet")] == [0]
    assert jobs.named(site.centre, HandIn, key[:SHORT]) == row
    with pytest.raises(UnknownError, match="no hand-in ''"):
        jobs.named(site.centre, HandIn, "")


def test_a_status_tells_what_matters(site):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    key = first.hand_in()[:SHORT]

    def lines(agent: Agent) -> list[str]:
        told = _status_lines(agent.status(), Path("r2"))
        return [re.sub(r"\d+\.\d MB", "1 MB", line) for line in told[1:]]

    own = "drives with its own map: it has taken none from the centre yet"
    assert lines(first) == [f"hand-in {key} (1 MB): to be sent", own]
    site.settle()
    kept = "merged in revision 1, kept until a backup of the centre holds it"
    assert lines(first)[0] == f"hand-in {key} (1 MB): {kept}"
    parked = "revision 1 is ready: when the robot is parked, engram agent switch r2"
    assert lines(second) == [own, parked]
    second.switch()
    second.drove(0.97, 1200.0)
    localised = "with it 97% of the frames localised over 1200 m"
    assert lines(second) == ["runs revision 1", localised]


def test_after_a_fall_back_only_what_is_new_is_handed_in(site):
    first, second = site.robot("r1"), site.robot("r2")
    drive(first.live, "r1", 1_000)
    drive(second.live, "r2", 2_000)
    first.hand_in()
    assert second.hand_in() is not None
    site.settle()
    assert second.switch()
    second.fall_back()
    assert second.hand_in() is None


def test_the_settings_of_an_agent_lie_in_its_folder(site):
    folder = site.robot("r1").folder
    (folder / "agent.toml").write_text("bytes_per_s = 1000\n")
    with _open(folder) as agent:
        assert agent.settings.bytes_per_s == 1000
    (folder / "agent.toml").write_text("bytes_per_second = 1000\n")
    with pytest.raises(ConfigError, match="did you mean bytes_per_s"):
        _open(folder)


def test_a_sync_that_failed_tells_scripts_so(site, capsys):
    agent = site.robot("r1")
    agent.state.remember(url="http://127.0.0.1:9")
    with pytest.raises(PartlyDoneError) as told:
        sync(agent.folder)
    assert isinstance(told.value.error, Unreachable)
    assert told.value.done["failures"] == 1
    assert "the last round failed: the centre cannot be reached" in capsys.readouterr().out


def test_half_an_enrolment_a_lost_key_and_a_file_in_the_way_are_named(site, tmp_path):
    agent = site.robot("r1")
    AgentState(tmp_path / "agent.sqlite").close()
    with pytest.raises(InputError, match="engram agent enrol"):
        Agent(tmp_path)
    (agent.folder / "key").write_bytes(b"")
    with pytest.raises(InputError, match=r"key is not a robot's key .*; remove it and enrol"):
        Agent(agent.folder)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file cannot hold an agent: Not a directory"):
        enrol(tmp_path / "file", "http://centre", "code", "r1", site.http)


def test_a_fact_that_is_not_one_is_named_with_its_file(site):
    agent = site.robot("r1")
    agent.state.remember(staged=3)
    with pytest.raises(MapError, match=r"agent\.sqlite holds an invalid fact .*staged.*enrol"):
        agent.status()
