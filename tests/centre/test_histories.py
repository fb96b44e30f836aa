"""Drives, broken links, kills, backups in any order, against the files merged in commit order."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

from engram.fleet.centre import handins, merge_job
from engram.fleet.centre.service import CentreSettings
from engram.fleet.centre.serving import back_up
from engram.fleet.centre.tables import JobState
from engram.fleet.centre.worker import sweep
from engram.fleet.merge.merging import merge
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .conftest import NAME, POLICY, Site, admit_here, drive
from .faults import dying

ROBOTS = ["r1", "r2"]
FATES = st.lists(
    st.one_of(st.sampled_from(["well", "lost", "unanswered", "twice"]), st.floats(0.0, 0.99)),
    max_size=4,
)


class FleetMachine(RuleBasedStateMachine):
    """The model: what each robot drove, and a copy of every map that was handed in."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.admit, merge_job.admit = merge_job.admit, admit_here
        # Nothing that is needed no more is kept for a while.
        self.site = Site(self.folder, settings=CentreSettings(kept_days=0))
        self.drives: set[tuple[str, int]] = set()
        self.copies: dict[str, Path] = {}
        self.backups: list[Path] = []
        self.order: list[str] = []
        for name in ROBOTS:
            self.site.robot(name)

    @rule(name=st.sampled_from(ROBOTS), nodes=st.integers(1, 2))
    def drive(self, name: str, nodes: int) -> None:
        start_ns = 1_000 * (len(self.drives) + 1)
        agent = self.site.robot(name)
        drive(agent.live, name, start_ns, nodes)
        self.drives.add((name, start_ns))

    @rule(name=st.sampled_from(ROBOTS), at=st.integers(1, 30))
    def hand_in(self, name: str, at: int) -> None:
        agent = self.site.robot(name)
        if not agent.live.exists():
            return
        copy = self.folder / f"copy{len(self.copies)}.engram"
        shutil.copyfile(agent.live, copy)
        with Map.open(copy) as store:
            self.copies.setdefault(store.content_hash(), copy)
        self.may_die(lambda: self.site.robot(name).hand_in(), at)

    @rule(at=st.integers(1, 20))
    def sweep(self, at: int) -> None:
        self.may_die(lambda: sweep(self.site.centre, NAME), at)

    @rule(name=st.sampled_from(ROBOTS), fates=FATES, at=st.integers(1, 60))
    def step(self, name: str, fates: list[str | float], at: int) -> None:
        self.site.link.fates = list(fates)
        self.may_die(lambda: self.site.robot(name).step(), at)
        self.site.link.fates = []

    @rule(at=st.integers(1, 80))
    def work(self, at: int) -> None:
        self.may_die(self.site.work, at)

    @rule(name=st.sampled_from(ROBOTS), at=st.integers(1, 12))
    def park(self, name: str, at: int) -> None:
        self.may_die(lambda: self.site.robot(name).switch(), at)

    @precondition(lambda self: len(self.backups) < 2)
    @rule()
    def back_up(self) -> None:
        self.backups.append(self.folder / f"backup{len(self.backups)}")
        back_up(self.site.centre, self.backups[-1])

    @precondition(lambda self: self.backups)
    @rule()
    def lose_the_centre(self) -> None:
        """Its disk is gone; the newest backup takes its place."""
        self.site.close()
        shutil.rmtree(self.folder / "centre")
        shutil.copytree(self.backups[-1], self.folder / "centre")
        self.site._open()
        for name in self.site.agents:
            self.site.agents[name] = self.site._agent(name)

    def may_die(self, action, at: int) -> None:
        with dying(at) as death:
            try:
                action()
            except BaseException:  # groups of them, out of the service's threads
                if not death.came:
                    raise
        if death.came:
            self.site.restart()

    def teardown(self) -> None:
        try:
            self.nothing_is_lost_or_done_twice()
        finally:
            self.site.close()
            merge_job.admit = self.admit
            shutil.rmtree(self.folder)

    def nothing_is_lost_or_done_twice(self) -> None:
        for name in ROBOTS:
            agent = self.site.robot(name)
            if agent.live.exists():
                copy = self.folder / f"last-{name}.engram"
                shutil.copyfile(agent.live, copy)
                with Map.open(copy) as store:
                    self.copies.setdefault(store.content_hash(), copy)
            agent.hand_in()
        self.site.settle()
        rows = handins.listed(self.site.centre, NAME)
        assert {row.state for row in rows} <= {JobState.MERGED}
        merged = sorted(rows, key=lambda row: row.place)
        place = self.site.centre.map_path(NAME)
        assert check_file(place).problems == ()
        with Map.open(place) as store:
            seen = {(one.robot, one.start_ns) for one in store.sessions.values()}
            content = store.content_hash()
        assert seen == self.drives
        if not merged:
            return
        files = [self.copies[row.content_hash] for row in merged]
        (self.folder / "files").mkdir()
        merge(self.folder / "files" / "fleet.engram", files, POLICY.merge)
        with Map.open(self.folder / "files" / "fleet.engram") as store:
            assert store.content_hash() == content
        for name in ROBOTS:
            agent = self.site.robot(name)
            agent.switch()
            if agent.live.exists():
                assert check_file(agent.live).problems == ()
                with Map.open(agent.live) as store:
                    own = {one for one in self.drives if one[0] == name}
                    assert own <= {(one.robot, one.start_ns) for one in store.sessions.values()}


TestFleet = FleetMachine.TestCase
TestFleet.settings = settings(
    max_examples=2, stateful_step_count=12, suppress_health_check=list(HealthCheck)
)


class LongFleetMachine(FleetMachine):
    """The same, many times."""


TestManyFleets = pytest.mark.long(LongFleetMachine.TestCase)
TestManyFleets.settings = settings(
    max_examples=200, stateful_step_count=25, suppress_health_check=list(HealthCheck)
)
