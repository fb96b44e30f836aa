"""Dreaming finds a better order where there is one, resumes, and never loses anything."""

from __future__ import annotations

import hashlib
import random
import shutil
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from tests.builders import World, dies_before, drive, map_simulated

from engram.errors import ConfigError, InputError
from engram.fleet.build.orders import JudgeOptions
from engram.fleet.centre import merge_job
from engram.fleet.dream import (
    BEHAVIOURS,
    DreamOptions,
    Try,
    dream,
    gain,
    hand_ins_of,
    keep_hand_in,
    try_all,
)
from engram.graph.model import Clock
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.measures import Drive
from engram.monitor import Monitor
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.sequence import SequenceInfo

from .robots import DAY_NS, OPTIONS, merged

ROAD = np.arange(0.0, 16.0, 0.7)
MORNING, NIGHT, DUSK = 0, 1, 2


class Twilight(World):
    """Every second point looks at dusk as in the morning, the others as at night."""

    def descriptors(self, appearance: int) -> np.ndarray:
        if appearance != DUSK:
            return super().descriptors(appearance)
        mixed = super().descriptors(MORNING).copy()
        mixed[::2] = super().descriptors(NIGHT)[::2]
        return mixed


TOWN = Twilight(20.0, seed=5)
ASKED = DreamOptions(
    merging=OPTIONS,
    localising=RobotOptions(relocaliser="exhaustive", ranking="distance"),
    judge_at_m=3.0,
)


def steps_of(appearance: int, day: int):
    return drive(TOWN, ROAD, appearance, aside_m=0.05 * day, start_ns=day * DAY_NS, seed=day)


def log_of(path: Path, appearance: int, day: int) -> Path:
    steps = steps_of(appearance, day)
    first = steps[0].frame
    info = SequenceInfo(path.stem, "synthetic", Clock.UTC, path.stem, longitude_deg=0.0)
    header = FrameLogHeader(info, first.camera, first.descriptor, first.frontend)
    with FrameLogWriter(path, header) as writer:
        for number, seen in enumerate(steps):
            writer.append(seen.logged, hashlib.sha256(f"{path.stem} {number}".encode()).hexdigest())
        writer.close(complete=True)
    return path


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Morning was handed in first: dusk, which matches it, was omitted. The drives are at night."""
    folder = tmp_path_factory.mktemp("town")
    robots = []
    for day, (name, appearance) in enumerate((("r1", MORNING), ("r2", DUSK)), start=1):
        robots.append(folder / f"{name}.engram")
        map_simulated(robots[-1], steps_of(appearance, day), name)
    centre = folder / "centre.engram"
    merged(centre, *robots)
    drives = [log_of(folder / f"v{day}.framelog", NIGHT, day) for day in (4, 5, 6)]
    return centre, robots, drives


def copy_of(centre: Path, folder: Path) -> Path:
    return Path(shutil.copy(centre, folder / "centre.engram"))


def nodes_of(path: Path) -> set:
    with Map.open(path) as store:
        return {node.id for node in store.load().nodes}


@pytest.mark.long
def test_a_better_order_is_found_and_what_it_has_is_added(town, tmp_path):
    centre, robots, drives = copy_of(town[0], tmp_path), town[1], town[2]
    before = nodes_of(centre)
    with Map.open(centre) as store:
        revision, omitted = store.revision, set(store.omissions)
    report = dream(centre, robots, drives, options=ASKED)
    assert report.complete
    assert report.order == (1, 0)
    assert report.missed_before > 0.9
    assert report.missed_after < 0.1
    assert report.better_by[1] > 0
    assert report.added is not None
    assert "revision" in report.text()
    with Map.open(centre) as store:
        assert store.revision == revision + 1
        assert store.log()[-1].message == f"dream: {report.behaviour}, order 1 0"
        assert omitted <= set(store.omissions)
    assert before < nodes_of(centre)
    for robot in robots:  # what robots out there hold is known, and handing it in adds nothing
        (again,) = merged(centre, robot)
        assert again.taken == 0
    assert check_file(centre).problems == ()
    assert not list(tmp_path.glob("*.dream/*"))


@pytest.mark.long
def test_where_nothing_is_better_the_fleet_map_stays_as_it_is(town, tmp_path):
    centre, robots, drives = copy_of(town[0], tmp_path), town[1], town[2]
    dream(centre, robots, drives, options=ASKED)
    with Map.open(centre) as store:
        content = store.content_hash()
    report = dream(centre, robots, drives, options=ASKED)
    assert report.added is None
    assert "unchanged" in report.text()
    with Map.open(centre) as store:
        assert store.content_hash() == content


class Stops(Monitor):
    def __init__(self, checks: int) -> None:
        self.left = checks

    def check(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


@pytest.mark.long
@pytest.mark.parametrize("checks", [1, 4, 9])
def test_a_stopped_dream_goes_on_to_the_same_result(town, tmp_path, checks):
    centre, robots, drives = copy_of(town[0], tmp_path), town[1], town[2]
    with pytest.raises(KeyboardInterrupt):
        dream(centre, robots, drives, options=ASKED, monitor=Stops(checks))
    assert nodes_of(centre) == nodes_of(town[0])
    report = dream(centre, robots, drives, options=ASKED)
    fresh = Path(shutil.copy(town[0], tmp_path / "fresh.engram"))
    whole = dream(fresh, robots, drives, options=ASKED)
    assert (report.behaviour, report.order) == (whole.behaviour, whole.order)
    assert report.better_by == whole.better_by
    assert nodes_of(centre) == nodes_of(fresh)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_killed_at_random_a_dream_goes_on_to_the_same_result(town, tmp_path):
    centre, robots, drives = copy_of(town[0], tmp_path), town[1], town[2]
    fresh = Path(shutil.copy(town[0], tmp_path / "fresh.engram"))
    whole = dream(fresh, robots, drives, options=ASKED)
    rng, kills = random.Random(7), 0
    while dies_before(rng.randrange(9000), lambda: dream(centre, robots, drives, options=ASKED)):
        kills += 1
        assert nodes_of(centre) in (nodes_of(town[0]), nodes_of(fresh))
        assert check_file(centre).problems == ()
    assert kills >= 2
    assert nodes_of(centre) == nodes_of(fresh)
    again = dream(centre, robots, drives, options=ASKED)
    assert (again.behaviour, again.order) == (whole.behaviour, whole.order)


@pytest.mark.long
@pytest.mark.parametrize("how", ["processes", "cluster"])
def test_side_by_side_or_on_a_cluster_the_result_is_the_same(town, tmp_path, how):
    centre, robots, drives = copy_of(town[0], tmp_path), town[1], town[2]
    here = Path(shutil.copy(town[0], tmp_path / "here.engram"))
    whole = dream(here, robots, drives, options=ASKED)
    if how == "processes":
        report = dream(centre, robots, drives, options=replace(ASKED, workers=2))
    else:
        distributed = pytest.importorskip("distributed", reason="no extra `cluster`")
        with distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, protocol="tcp",
            dashboard_address=None,
        ) as started:  # fmt: skip
            asked = replace(ASKED, scheduler=started.scheduler_address)
            report = dream(centre, robots, drives, options=asked)
    assert report.complete
    assert (report.behaviour, report.order) == (whole.behaviour, whole.order)
    assert report.better_by == whole.better_by
    assert nodes_of(centre) == nodes_of(here)


@pytest.mark.long
def test_a_time_budget_ends_the_trying_and_the_best_so_far_counts(town, tmp_path):
    centre, robots, drives = copy_of(town[0], tmp_path), town[1], town[2]
    short = DreamOptions(
        minutes=1e-9, merging=ASKED.merging, localising=ASKED.localising, judge_at_m=3.0
    )
    report = dream(centre, robots, drives, options=short)
    assert not report.complete
    assert report.tried == {}
    assert "the same command tries more" in report.text()
    assert dream(centre, robots, drives, options=ASKED).tried.keys() == BEHAVIOURS.keys()


def orders_tried(robots: list[Path], drives: list[Path], folder: Path) -> Try:
    judge = JudgeOptions(drives, judge_at_m=3.0, localising=ASKED.localising)
    return Try(folder, robots, judge, Settings(), ASKED.merging, None)


@pytest.mark.parametrize("end_s", [None, 4e9])
def test_whoever_watches_a_dream_learns_how_much_there_is_to_try(
    town, tmp_path, monkeypatch, end_s
):
    monkeypatch.setattr(merge_job, "_REPORT_S", 0.0)
    told: list[str] = []
    monitor = merge_job.JobMonitor(lambda progress: bool(told.append(progress)))
    asked = replace(orders_tried(town[1], town[2], tmp_path / "results"), end_s=end_s)
    assert try_all({"usual": asked}, 1, None, monitor)
    assert told[-1] == "try orders: 1 of 2"
    monitor.check()
    assert told[-1] == "try orders: 2 of 2"


@pytest.mark.long
def test_beside_each_other_dreams_have_one_bar(town, tmp_path):
    class Heard(Monitor):
        stages: ClassVar[list[tuple[str, int]]] = []
        words: ClassVar[list[str]] = []

        def stage(self, what: str, total: int) -> AbstractContextManager[Monitor]:
            self.stages.append((what, total))
            return nullcontext(self)

        def advance(self, word: str = "") -> None:
            self.words.append(word)

    asked = {
        name: orders_tried(town[1], town[2], tmp_path / name) for name in ("usual", "once more")
    }
    assert try_all(asked, 2, None, Heard())
    assert Heard.stages == [("try orders", 4)]
    assert len(Heard.words) == 4


def test_hand_ins_are_kept_once_in_the_order_in_which_they_came(town, tmp_path):
    centre, robots, _ = copy_of(town[0], tmp_path), town[1], town[2]
    kept = [keep_hand_in(centre, robot) for robot in (*reversed(robots), robots[0])]
    assert hand_ins_of(centre) == kept[:2]
    assert kept[2] == kept[1]
    assert nodes_of(kept[0]) == nodes_of(robots[1])


def test_what_would_tell_nothing_is_refused(town, tmp_path):
    centre, robots, drives = copy_of(town[0], tmp_path), town[1], town[2]
    with pytest.raises(ConfigError, match="too few to rule out chance"):
        dream(centre, robots, drives[:2], options=ASKED)
    with pytest.raises(InputError, match="nothing was handed in"):
        dream(centre, [], drives, options=ASKED)


def test_the_gain_is_paired_over_drives():
    before = [Drive(np.ones(10), np.arange(10) < n) for n in (2, 5, 8)]
    after = [Drive(np.ones(10), np.arange(10) < n) for n in (4, 7, 10)]
    estimate, low, high = gain(before, after, resamples=2000, level=0.9, seed=0)
    assert estimate == pytest.approx(0.2)
    assert (low, high) == (pytest.approx(0.2), pytest.approx(0.2))
