"""Dreams are dreamt when nobody waits, once, and given up for whatever comes."""

from __future__ import annotations

import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from tests.fleet.test_dreaming import ASKED as USUAL
from tests.fleet.test_dreaming import nodes_of, town

from engram.errors import WorkerError
from engram.fleet.centre import dreams, handins, jobs, merge_job, worker
from engram.fleet.centre.problems import ConflictError
from engram.fleet.centre.service import MapPolicy
from engram.fleet.centre.tables import Dream, HandIn
from engram.fleet.centre.worker import dream_a_while
from engram.fleet.dream import DreamReport
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map

from .conftest import NAME, POLICY, Site, admit_here, drive
from .faults import dying

__all__ = ["town"]
GATE = ("v1", "v2", "v3")
HOUR_NS = 3_600_000_000_000


@pytest.mark.parametrize(
    ("quiet", "hour", "expected"),
    [
        ((22.0, 5.0), 23.5, True),
        ((22.0, 5.0), 4.9, True),
        ((22.0, 5.0), 5.0, False),
        ((9.0, 17.0), 8.0, False),
        ((9.0, 17.0), 9.0, True),
        ((0.0, 24.0), 13.0, True),
        (None, 13.0, False),
    ],
)
def test_quiet_hours_may_go_past_midnight(quiet, hour, expected):
    assert MapPolicy(quiet=quiet).is_quiet(round(hour * HOUR_NS) + 24 * HOUR_NS) is expected


def test_there_must_be_something_to_dream_of_and_to_judge_it_by(site, in_process):
    with pytest.raises(ConflictError, match="0 held-out drives"):
        dreams.ask(site.centre, NAME, "tests")
    judged(site)
    with pytest.raises(ConflictError, match="nothing is merged"):
        dreams.ask(site.centre, NAME, "tests")


def test_the_worker_asks_in_quiet_hours_and_a_person_at_any_time(site, in_process):
    handed_in(site, "r1", 1_000)
    judged(site)
    dreams.ask_quietly(site.centre)
    assert dreams.listed(site.centre, NAME) == []
    judged(site, quiet=hours_from(site, 0.0))
    dreams.ask_quietly(site.centre)
    (row,) = dreams.due(site.centre)
    judged(site, quiet=hours_from(site, 3.0))
    assert dreams.due(site.centre) == []
    answer = site.http.post(f"/v1/maps/{NAME}/dreams", headers=site.token("operator"))
    assert answer.json()["id"] == row.id
    assert [one.id for one in dreams.due(site.centre)] == [row.id]
    told = site.http.get(f"/v1/maps/{NAME}/jobs", headers=site.token("viewer")).json()
    assert [(one["kind"], one["id"]) for one in told] == [("dream", row.id)]


def test_a_dream_that_a_hand_in_has_overtaken_is_asked_for_anew(site, in_process):
    handed_in(site, "r1", 1_000)
    judged(site)
    before = dreams.ask(site.centre, NAME, "tests")
    judged(site, gate=())
    handed_in(site, "r2", 5_000)
    judged(site)
    (row,) = dreams.due(site.centre)
    assert row.id != before.id
    assert row.asked_by == "tests"
    assert jobs.get(site.centre, Dream, before.id).state == "cancelled"


def test_what_a_person_hid_is_not_dreamt_of_until_it_is_handed_in_again(site, in_process):
    handed_in(site, "r1", 1_000)
    handed_in(site, "r2", 5_000)
    assert len(dreams.merged_handins(site.centre, NAME)) == 2
    with Map.open(site.centre.map_path(NAME)) as store:
        store.revert(1, author="tests")
    (row,) = dreams.merged_handins(site.centre, NAME)
    assert row.robot == site.robot("r2").state.facts.robot
    handed_in(site, "r1", 9_000)
    assert len(dreams.merged_handins(site.centre, NAME)) == 2


def test_a_robots_map_is_put_together_with_what_it_got_from_the_fleet(site, in_process, tmp_path):
    handed_in(site, "r1", 1_000)
    second = site.robot("r2")
    second.step()
    site.settle()
    assert second.switch()
    handed_in(site, "r2", 5_000)
    (row,) = [
        one
        for one in dreams.merged_handins(site.centre, NAME)
        if one.robot == second.state.facts.robot
    ]
    manifest = handins.manifest_of(site.centre, row)
    path = tmp_path / "r2.engram"
    admit_here(manifest, dreams.parts_of(site.centre, row, manifest), path)
    with Map.open(path) as store, Map.open(second.live) as live:
        assert store.content_hash() == live.content_hash()
        assert len(list(store.frames.stored(store.load().nodes))) == len(live.load().nodes)


def test_what_a_killed_dream_left_goes_when_it_is_not_dreamt_again(site):
    left = site.centre.folder / "work" / "dream-gone"
    left.mkdir()
    (left / "0000.engram").write_bytes(b"a copy")
    assert not dream_a_while(site.centre, lambda _: None, lambda: False)
    assert not left.exists()


class DreamMachine(RuleBasedStateMachine):
    """The model: what was dreamt of. The dreams themselves are of a moment."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(merge_job, "admit", admit_here)
        self.patch.setattr(worker, "admit", admit_here)
        self.patch.setattr(worker, "dream", self.dreamt)
        self.patch.setattr(worker, "_dream_apart", self.beside)
        self.site = Site(self.folder)
        self.whole: list[tuple[str, ...]] = []
        self.ended: set[str] = set()
        self.drives = 0
        for name in ("r1", "r2"):
            self.site.robot(name)
        self.policy(quiet=False)

    def beside(self, centre, row, wait, stopped, scheduler) -> None:
        assert jobs.pending(centre, HandIn) == []
        worker.dream_of(centre, row)

    def dreamt(self, path, handed, *_) -> DreamReport:
        """As the fleet's dream: it reads what was handed in."""
        contents = []
        for one in handed:
            with Map.open(one) as store:
                contents.append(store.content_hash())
        self.whole.append(tuple(contents))
        return DreamReport(str(path), complete=True)

    @rule(quiet=st.booleans())
    def policy(self, quiet: bool) -> None:
        judged(self.site, quiet=hours_from(self.site, 0.0 if quiet else 3.0))

    @rule(name=st.sampled_from(["r1", "r2"]))
    def hand_in(self, name: str) -> None:
        self.drives += 1
        agent = self.site.robot(name)
        drive(agent.live, name, 1_000 * self.drives, 1)
        agent.hand_in()
        while agent.step(fetch=False) == 0:
            pass

    @rule()
    def ask(self) -> None:
        if dreams.merged_handins(self.site.centre, NAME):
            dreams.ask(self.site.centre, NAME, "tests")

    @rule()
    def cancel(self) -> None:
        for row in jobs.pending(self.site.centre, Dream, NAME):
            jobs.cancel(self.site.centre, row, "tests")

    @rule(at=st.integers(1, 60))
    def work(self, at: int) -> None:
        with dying(at) as death:
            try:
                judged(self.site, gate=())  # the drives of the gate are names only
                self.site.work()
                judged(self.site)
                dream_a_while(self.site.centre, lambda _: None, lambda: False)
            except BaseException:
                if not death.came:
                    raise
        if death.came:
            self.site.restart()
        judged(self.site)

    @invariant()
    def what_is_done_stays_done_and_nothing_is_left(self) -> None:
        rows = dreams.listed(self.site.centre, NAME)
        done = {row.id for row in rows if row.state == "done"}
        assert self.ended <= done
        self.ended = done
        assert not any(row.state == "failed" for row in rows), rows

    def teardown(self) -> None:
        try:
            self.policy(quiet=True)
            judged(self.site, gate=())
            while self.site.work():
                pass
            self.policy(quiet=True)
            merged = dreams.merged_handins(self.site.centre, NAME)
            while dream_a_while(self.site.centre, lambda _: None, lambda: False):
                pass
            centre, state = self.site.centre, "done"
            if merged:
                state = jobs.get(centre, Dream, dreams.key_of(centre, NAME)).state
            assert state in {"done", "cancelled"}
            if state == "done" and merged:
                assert tuple(row.content_hash for row in merged) in self.whole
            assert not list((self.site.centre.folder / "work").glob("[!.]*"))
        finally:
            self.site.close()
            self.patch.undo()
            shutil.rmtree(self.folder)


TestDreams = DreamMachine.TestCase
TestDreams.settings = settings(
    max_examples=2, stateful_step_count=8, suppress_health_check=list(HealthCheck)
)


class LongDreamMachine(DreamMachine):
    """The same, many times."""


TestManyDreams = pytest.mark.long(LongDreamMachine.TestCase)
TestManyDreams.settings = settings(
    max_examples=200, stateful_step_count=30, suppress_health_check=list(HealthCheck)
)


@pytest.mark.long
def test_a_better_order_becomes_a_revision_and_a_hand_in_interrupts(tmp_path, town, monkeypatch):
    """The whole way, in real processes."""
    _, robots, drives = town
    site = Site(tmp_path)
    policy = MapPolicy(USUAL.merging, tuple(map(str, drives)), "stable")
    site.centre.set_policy(NAME, replace(policy, gate=()), "tests")
    for path in robots:
        agent = site.robot(path.stem)
        agent.live.parent.mkdir(exist_ok=True)
        copy_map(path, agent.live)
        agent.hand_in()
        site.settle()
    before = nodes_of(site.centre.map_path(NAME))
    site.centre.set_policy(NAME, policy, "tests")
    row = dreams.ask(site.centre, NAME, "tests")
    asked = iter([False, True])
    with monkeypatch.context() as patch:
        patch.setattr(worker, "_is_needed", lambda _: next(asked))
        assert dream_a_while(site.centre, time.sleep, lambda: False)
    assert jobs.get(site.centre, Dream, row.id).state == "asked"
    assert nodes_of(site.centre.map_path(NAME)) == before
    assert dream_a_while(site.centre, time.sleep, lambda: False)
    row = jobs.get(site.centre, Dream, row.id)
    assert (row.state, row.error) == ("done", None)
    report = row.report
    assert report["better_by"][1] > 0
    assert before < nodes_of(site.centre.map_path(NAME))
    assert check_file(site.centre.map_path(NAME)).problems == ()
    with Map.open(site.centre.map_path(NAME)) as store:
        assert row.revision == store.revision
    answer = site.http.get(f"/v1/maps/{NAME}/refs/stable", headers=site.token("viewer"))
    assert answer.json()["revision"] == row.revision
    assert not dream_a_while(site.centre, time.sleep, lambda: False)
    site.close()


@pytest.mark.long
def test_a_dream_whose_process_dies_is_told_to_have_failed(site, in_process, monkeypatch):
    handed_in(site, "r1", 1_000)
    judged(site)
    row = dreams.ask(site.centre, NAME, "tests")
    monkeypatch.setattr(worker, "_dream_here", dies)
    assert dream_a_while(site.centre, time.sleep, lambda: False)
    assert "exit code 1" in jobs.get(site.centre, Dream, row.id).error


def dies(*_: object) -> None:
    raise WorkerError("here")


def judged(site, **change) -> None:
    """Three held-out drives, which nobody reads where the merge has no gate."""
    kept = site.centre.policy(NAME)
    policy = replace(POLICY, **{"quiet": kept.quiet, "gate": GATE, **change})
    site.centre.set_policy(NAME, policy, "tests")


def hours_from(site, later_h: float) -> tuple[float, float]:
    """Two quiet hours that begin so much later than the hour of now."""
    now_h = site.clock.now_ns / HOUR_NS % 24
    return (now_h - 0.5 + later_h) % 24, (now_h + 1.5 + later_h) % 24


def handed_in(site, name: str, start_ns: int) -> None:
    agent = site.robot(name)
    drive(agent.live, name, start_ns)
    agent.hand_in()
    while agent.step(fetch=False) == 0:
        pass
    site.work()
