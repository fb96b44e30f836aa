"""Robots that map or remember while they drive."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.builders import Seen, World, drive, session_for

from engram.doctor.examination import DoctorConfig
from engram.errors import ConfigError, MapError, MapLockedError, StorageFullError
from engram.fleet.merge.merging import merge
from engram.maps.map import Map, open_map
from engram.maps.map_files import check_file
from engram.maps.sqlite import SqliteDatabase
from engram.maps.writer import RevisionWriter
from engram.robot.drive_session import SavingState
from engram.robot.robot import Robot
from engram.robot.settings import Settings

WORLD = World(30.0)
ROAD = np.arange(0.0, 25.0, 0.7)
FIRST = drive(WORLD, ROAD)
AGAIN = drive(WORLD, ROAD + 0.3, seed=1, start_ns=10**15)
CAMERA = FIRST[0].frame.camera


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "town.engram"


@pytest.fixture
def town(path: Path) -> Iterator[Map]:
    with open_map(path, create=True) as opened:
        yield opened


def run(robot: Robot, frames: list[Seen]) -> list[str]:
    found = [robot.step(seen.logged) for seen in frames]
    return ["saved" if one.saved else one.status.value for one in found]


def mapped(path: Path) -> None:
    with (
        open_map(path, create=True) as opened,
        opened.robot(CAMERA, Settings(), name="r1", maps=True) as robot,
    ):
        run(robot, FIRST)


def test_what_a_robot_maps_becomes_a_revision_and_the_next_one_is_localised(path: Path) -> None:
    mapped(path)
    assert check_file(path).sound
    with open_map(path) as town:
        assert town.revision == 1
        assert [one.robot for one in town.sessions.values()] == ["r1"]
        assert town.node_count() > 15
        with town.robot(CAMERA) as robot:
            words = run(robot, AGAIN)
    assert words.count("localised") > 0.9 * len(AGAIN)


def most_tasks(robot: Robot, frames: list[Seen]) -> tuple[int, list[str]]:
    """Threads that a drive added to the caller's at most, that one included; what was found."""
    running = Path("/proc/self/task")
    before, tasks = len(list(running.iterdir())), [0]
    robot.watch = lambda *_: tasks.append(len(list(running.iterdir())))
    with robot:
        found = [one.status.value for one in robot.drive(seen.logged for seen in frames)]
    return max(tasks) - before + 1, found


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="counts threads as Linux does")
def test_a_robot_has_no_more_threads_than_it_is_given_and_finds_the_same(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("engram.localiser.localiser.cores", lambda: 8)
    mapped(path)
    found = {}
    for threads, most in ((None, 8), (6, 6), (5, 5)):
        copy = tmp_path / f"{most}.engram"
        copy.write_bytes(path.read_bytes())
        with open_map(copy) as town:
            robot = town.robot(CAMERA, name="r2", maps=True, lanes=4, threads=threads)
            tasks, found[most] = most_tasks(robot, AGAIN)
        assert most - 1 <= tasks <= most  # landmarks that are in memory need no thread
    assert found[8] == found[6] == found[5]


def test_too_few_threads_are_refused_and_nothing_is_begun(path: Path, town: Map) -> None:
    with pytest.raises(ConfigError, match="threads is 4, must be at least 5 for this robot"):
        town.robot(CAMERA, name="r1", maps=True, threads=4)
    with pytest.raises(ConfigError, match=r"must be at least 4 .* decodes images, reads the map"):
        town.robot(CAMERA, name="r1", remembers=True, threads=3)
    with pytest.raises(ConfigError, match="threads is 0"):
        town.robot(CAMERA, threads=0)
    town.robot(CAMERA, threads=3).close()
    with town.robot(CAMERA, name="r1", maps=True, threads=5):  # the map is not left locked
        assert town.node_count() == 0


def test_others_see_committed_revisions_only(path: Path, town: Map) -> None:
    with town.robot(CAMERA, name="r1", maps=True) as robot:
        words = run(robot, FIRST)
        assert words.count("saved") == robot.saving.nodes > 15
        with open_map(path) as other:
            assert other.node_count() == 0
            with other.robot(CAMERA) as stranger:
                assert run(stranger, AGAIN[:3]) == ["lost", "lost", "lost"]
        assert robot.saving.state is SavingState.ON
    assert robot.saving.state is SavingState.COMMITTED
    assert robot.saving.revision == 1
    with open_map(path) as other:
        assert other.node_count() == robot.saving.nodes


def test_the_same_drive_gives_the_nodes_that_map_gives_wherever_it_comes_from(path: Path) -> None:
    """A robot sees what it saves: a lap that comes back is localised in its own nodes."""
    lap = World(2 * np.pi * 12.0, radius_m=12.0, seed=5)
    round_and_round = drive(lap, np.arange(0.0, 1.4 * 2 * np.pi * 12.0, 0.7))
    with open_map(path, create=True) as town, town.robot(CAMERA, name="r1", maps=True) as robot:
        words = run(robot, round_and_round)
    assert words[: len(words) // 2].count("localised") == 0
    assert words[-10:].count("localised") > 5


def test_a_full_disk_ends_saving_and_not_localising(
    path: Path, town: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint, made = RevisionWriter.checkpoint, []

    def full(writer: RevisionWriter) -> None:
        made.append(1)
        if len(made) > 1:
            raise StorageFullError("no space is left")
        checkpoint(writer)

    monkeypatch.setattr(RevisionWriter, "checkpoint", full)
    road = drive(World(90.0), np.arange(0.0, 80.0, 0.7))
    with town.robot(CAMERA, name="r1", maps=True) as robot:
        words = run(robot, road)
        words += run(robot, drive(World(90.0), np.arange(0.0, 80.0, 0.7), seed=1, start_ns=10**15))
        assert robot.saving.state is SavingState.FAILED
        assert "no space" in robot.saving.reason
        monkeypatch.undo()
    assert 0 < words.count("saved") < 80
    # What was written before is a revision, and the robot went on in what it had in memory.
    assert robot.saving.revision == 1
    with open_map(path) as town_again:
        assert 0 < town_again.node_count() <= words.count("saved")
    assert words.count("localised") > 0


def killed_at_the_end(robot: Robot, frames: list[Seen]) -> Robot:
    """A robot that maps a drive, of which all was written; the process dies before it commits."""
    run(robot, frames)
    live = robot._live
    live._session.close()
    live._stack.close()
    robot._live = None
    robot.close()
    return robot


def test_a_killed_robot_goes_on_in_what_it_had_mapped(path: Path, town: Map) -> None:
    killed_at_the_end(town.robot(CAMERA, name="r1", maps=True), FIRST)
    with open_map(path) as opened, opened.robot(CAMERA, name="r1", maps=True) as robot:
        assert robot.saving.recovered == (1,)
        assert opened.node_count() > 15, "the map that it was asked of sees the sealed nodes, too"
        words = run(robot, AGAIN)
    assert words.count("localised") > 0.9 * len(AGAIN)
    assert "saved before an interruption: revision 1" in robot.saving.text()
    with open_map(path) as after:
        assert [one.message for one in after.log()] == ["map r1", "map r1"]
        assert len(after.sessions) == 2
        assert after.interrupted() == []
    assert check_file(path).sound


def test_a_drive_that_is_played_again_after_a_kill_is_another_session(path: Path) -> None:
    for played in range(3):
        with open_map(path, create=True) as town:
            robot = town.robot(CAMERA, name="r1", maps=True)
            assert robot.saving.recovered == ((played,) if played else ())
            killed_at_the_end(robot, FIRST[: 10 + 5 * played])
            assert robot.saving.state is SavingState.ON, robot.saving.reason
    with open_map(path) as town, town.robot(CAMERA, name="r1", maps=True) as robot:
        words = run(robot, FIRST)
    assert robot.saving.revision == 4
    assert words[:20].count("localised") == 20
    with open_map(path) as town:
        # Each goes on where the one before was killed, and maps nothing twice.
        stamps_ns = [node.stamp_ns for node in town.graph.nodes]
        assert stamps_ns == sorted(set(stamps_ns))
        assert words.count("saved") > 0
        assert len(town.sessions) == 4


def test_what_others_were_mapping_is_not_sealed(path: Path, town: Map) -> None:
    killed_at_the_end(town.robot(CAMERA, name="r2", maps=True), FIRST)
    with open_map(path) as opened, opened.writing():  # as `engram map` leaves it
        session = session_for(AGAIN, "r1")
        writer = opened.begin_session(
            session, CAMERA, descriptor=FIRST[0].frame.descriptor, frontend="f" * 12,
            author="r1", configuration={},
        )  # fmt: skip
        writer.checkpoint()
    with open_map(path) as opened, opened.robot(CAMERA, name="r1", maps=True) as robot:
        run(robot, FIRST[:5])
    assert robot.saving.recovered == ()
    with open_map(path) as after:
        assert {one.session.robot for one in after.interrupted()} == {"r1", "r2"}


def test_where_nothing_can_be_sealed_the_robot_localises_and_saves_nothing(
    path: Path, town: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed_at_the_end(town.robot(CAMERA, name="r1", maps=True), FIRST)

    def full(*_: object) -> None:
        raise StorageFullError("no space is left")

    monkeypatch.setattr(RevisionWriter, "commit", full)
    with open_map(path) as opened, opened.robot(CAMERA, name="r1", maps=True) as robot:
        assert set(run(robot, AGAIN[:5])) == {"lost"}
    assert robot.saving.state is SavingState.FAILED
    assert "no space is left" in robot.saving.text()
    monkeypatch.undo()
    with open_map(path) as opened, opened.robot(CAMERA, name="r1", maps=True) as robot:
        assert robot.saving.recovered == (1,)


@pytest.mark.parametrize(
    ("error", "is_raised"), [(MapError("is read-only"), False), (MapLockedError("locked"), True)]
)
def test_on_a_read_only_disk_a_mapping_robot_localises(
    path: Path, monkeypatch: pytest.MonkeyPatch, error: MapError, is_raised: bool
) -> None:
    mapped(path)

    def fails(_: object) -> None:
        raise error

    monkeypatch.setattr(SqliteDatabase, "lock_for_writing", fails)
    with open_map(path) as opened:
        if is_raised:
            with pytest.raises(MapLockedError):
                opened.robot(CAMERA, name="r1", maps=True)
            return
        with opened.robot(CAMERA, name="r1", maps=True) as robot:
            assert "localised" in run(robot, AGAIN[:5])
    assert robot.saving.state is SavingState.FAILED
    assert "is read-only" in robot.saving.text()


def test_a_drive_that_the_map_holds_is_not_saved_again(path: Path) -> None:
    mapped(path)
    with open_map(path) as town, town.robot(CAMERA, name="r1", maps=True) as robot:
        assert run(robot, FIRST).count("localised") > 0.9 * len(FIRST)
    assert robot.saving.state is SavingState.FAILED
    assert "holds this drive already" in robot.saving.reason


def test_a_crash_leaves_a_session_that_can_be_sealed(path: Path, town: Map) -> None:
    robot = killed_at_the_end(town.robot(CAMERA, Settings(), name="r1", maps=True), FIRST)
    with open_map(path) as after:
        assert after.node_count() == 0
        (interrupted,) = after.interrupted()
        with after.writing():
            after.seal(interrupted.session.id)
        assert after.node_count() == robot.saving.nodes


def test_a_drive_is_remembered_without_nodes(path: Path) -> None:
    mapped(path)
    with open_map(path) as town:
        before = town.info()
        with town.robot(CAMERA, name="r2", remembers=True) as robot:
            words = run(robot, AGAIN)
    assert words.count("saved") == 0
    assert robot.saving.state is SavingState.COMMITTED
    assert robot.saving.revision == 2
    assert sorted(one.name for one in path.parent.glob("*memory*")) == []
    with open_map(path) as town:
        after = town.info()
        assert {one.robot for one in town.sessions.values()} == {"r1", "r2"}
        assert after.nodes == before.nodes
        assert after.path_entries > before.path_entries
        assert after.attempts > before.attempts
        remembered = next(one for one in town.sessions.values() if one.robot == "r2")
        assert remembered.id == robot.saving.session
    assert check_file(path).sound


def test_a_memory_waits_while_another_writes_and_is_committed_by_the_next(path: Path) -> None:
    mapped(path)
    with open_map(path) as town, open_map(path) as writer:
        with writer.writing(), town.robot(CAMERA, name="r2", remembers=True) as robot:
            run(robot, AGAIN)
            robot.close()
        assert robot.saving.state is SavingState.SPOOLED
        assert Path(robot.saving.reason).exists()
        later = drive(WORLD, ROAD + 0.1, seed=2, start_ns=2 * 10**15)
        with open_map(path) as again, again.robot(CAMERA, name="r3", remembers=True) as other:
            run(other, later)
    assert not Path(robot.saving.reason).exists()
    with open_map(path) as town:
        assert town.revision == 3
        assert {one.robot for one in town.sessions.values()} == {"r1", "r2", "r3"}


def test_a_drive_without_a_memory_does_not_pass_off_anothers_as_its_own(path: Path) -> None:
    mapped(path)
    with open_map(path) as town, open_map(path) as writer:
        with writer.writing(), town.robot(CAMERA, name="r2", remembers=True) as robot:
            run(robot, AGAIN[:5])
            robot.close()
        assert robot.saving.state is SavingState.SPOOLED
        elsewhere = drive(World(10.0, seed=9), ROAD[:3], start_ns=2 * 10**15)
        with town.robot(CAMERA, name="r3", remembers=True) as other:
            assert run(other, elsewhere).count("localised") == 0
    assert other.saving.revision is None
    with open_map(path) as town:
        assert [one.author for one in town.log()] == ["r1", "r2"]


def test_a_torn_memory_is_committed_as_far_as_it_is_whole(path: Path) -> None:
    mapped(path)
    with (
        open_map(path) as town,
        open_map(path) as writer,
        writer.writing(),
        town.robot(CAMERA, name="r2", remembers=True) as robot,
    ):
        run(robot, AGAIN)
    spool = Path(robot.saving.reason)
    spool.write_bytes(spool.read_bytes()[:-7])
    with open_map(path) as town, town.robot(CAMERA, name="r3", remembers=True) as other:
        run(other, drive(WORLD, ROAD + 0.1, seed=2, start_ns=2 * 10**15))
    assert not spool.exists()
    with open_map(path) as town:
        assert {one.robot for one in town.sessions.values()} == {"r1", "r2", "r3"}
    assert check_file(path).sound


def test_a_memory_is_merged_like_any_other_session(path: Path, tmp_path: Path) -> None:
    mapped(path)
    centre = tmp_path / "centre.engram"
    merge(centre, [path])
    with open_map(path) as town, town.robot(CAMERA, name="r2", remembers=True) as robot:
        run(robot, AGAIN)
    with open_map(centre) as town:
        before = town.info()
    merge(centre, [path])
    with open_map(centre) as town:
        after = town.info()
        assert robot.saving.session in town.sessions
    assert after.nodes == before.nodes
    assert after.path_entries > before.path_entries
    assert after.attempts > before.attempts


def test_a_robot_whose_drives_are_kept_needs_a_name(town: Map) -> None:
    for how in ({"maps": True}, {"remembers": True}):
        with pytest.raises(ConfigError, match="needs a name"):
            town.robot(CAMERA, **how)


def test_a_closed_robot_leaves_no_threads(path: Path) -> None:
    before = threading.active_count()
    mapped(path)
    assert threading.active_count() == before


SECOND_NS = 10**9


def shifted(drive: list[Seen], first: int, by_s: float, last: int | None = None) -> list[Seen]:
    """A drive whose stamps are off from one frame on, to before another."""
    by_ns = [
        round(by_s * SECOND_NS) if first <= at < (last or len(drive)) else 0
        for at in range(len(drive))
    ]
    return [
        replace(one, frame=replace(one.frame, stamp_ns=one.frame.stamp_ns + off_ns))
        for one, off_ns in zip(drive, by_ns, strict=True)
    ]


@pytest.mark.parametrize("keeps", [{"maps": True}, {"remembers": True}, {}])
@pytest.mark.parametrize("by_s", [-0.5, pytest.param(-3600.0, marks=pytest.mark.long), 3600.0])
@pytest.mark.parametrize("at", [pytest.param(1, marks=pytest.mark.long), 30])
def test_a_clock_that_is_set_costs_two_frames_and_never_the_drive(
    path: Path, keeps: dict[str, bool], by_s: float, at: int
) -> None:
    mapped(path)
    taken = shifted(AGAIN, at, by_s)
    with open_map(path) as town, town.robot(CAMERA, name="r2", **keeps) as robot:
        found = [robot.step(seen.logged) for seen in taken]
        lost = [k for k, one in enumerate(found) if one.status == "no_odometry"]
        assert set(lost) <= {at, at + 1}
        assert [one.stamp_ns for one in found] == [one.frame.stamp_ns for one in taken]
        late = found[at + 3 :]
        assert sum(one.localised for one in late) >= 0.9 * len(late)
        assert not robot.diagnosis.fatal
        assert "clock_set" in {one.code for one in robot.diagnosis.findings} or by_s > 0
    if keeps:
        assert robot.saving.state is SavingState.COMMITTED
    assert check_file(path).sound


@pytest.mark.parametrize("by_s", [-3600.0, 0.5, 3600.0])
@pytest.mark.parametrize("at", [pytest.param(1, marks=pytest.mark.long), 35])
@pytest.mark.parametrize("maps", [True, False])
def test_one_wrong_stamp_costs_its_own_frame(path: Path, by_s: float, at: int, *, maps) -> None:
    mapped(path)
    taken = shifted(AGAIN, at, by_s, at + 1)
    with open_map(path) as town, town.robot(CAMERA, name="r2", maps=maps) as robot:
        found = [robot.step(seen.logged) for seen in taken]
    lost = {k for k, one in enumerate(found) if one.status == "no_odometry"}
    assert lost <= {at}
    codes = {one.code for one in robot.diagnosis.findings}
    assert codes & {"stamps_backwards", "clock_set", "stamp_jump"} or not lost


def test_a_position_that_is_not_followed_does_not_stay_sharp(path: Path) -> None:
    """A clock that stands still for good: nothing places the frames any more."""
    mapped(path)
    stuck = [
        replace(one, frame=replace(one.frame, stamp_ns=AGAIN[10].frame.stamp_ns))
        for one in AGAIN[11:]
    ]
    with open_map(path) as town, town.robot(CAMERA) as robot:
        known = [robot.step(seen.logged) for seen in AGAIN[:11]][-1]
        blind = [robot.step(seen.logged) for seen in stuck]
    assert known.position is not None
    assert {one.status.value for one in blind} == {"no_odometry"}
    for gone, one in enumerate(blind, start=1):
        assert one.position is not None
        way_m = np.linalg.norm(
            one.position.node_from_live.translation - known.position.node_from_live.translation
        )
        assert one.position.sigma_m > known.position.sigma_m
        # It goes on at the last speed, and says how far that may be off.
        assert abs(way_m - 0.7 * gone) < 3 * one.position.sigma_m


def numbered(drive: list[Seen]) -> list[Seen]:
    """A drive that no doctor lets pass: its stamps are milliseconds, one a frame."""
    return [
        replace(one, frame=replace(one.frame, stamp_ns=number * 1_000_000))
        for number, one in enumerate(drive)
    ]


def test_what_an_unfit_robot_mapped_waits_and_is_not_committed(path: Path) -> None:
    with (
        open_map(path, create=True) as town,
        town.robot(CAMERA, name="r1", maps=True) as robot,
    ):
        run(robot, numbered(FIRST))
    assert robot.saving.state is SavingState.UNCOMMITTED
    assert robot.saving.state == "uncommitted"
    assert "the stamps are the numbers of the frames" in robot.saving.text()
    assert "engram check --seal" in robot.saving.text()
    with open_map(path) as town:
        assert town.revision == 0
        (waiting,) = town.interrupted()
        assert waiting.nodes > 15
        with town.robot(CAMERA, name="r1", maps=True) as robot:  # a later one does not commit it
            run(robot, AGAIN)
        assert robot.saving.recovered == ()
        assert [one.session for one in town.interrupted()] == [waiting.session]


def test_an_unfit_robot_stops_mapping_when_the_doctor_has_seen_enough(path: Path) -> None:
    settings = Settings(doctor=DoctorConfig(frames=15))
    with (
        open_map(path, create=True) as town,
        town.robot(CAMERA, settings, name="r1", maps=True) as robot,
    ):
        words = run(robot, numbered(FIRST))
        assert robot.saving.state is SavingState.UNCOMMITTED
    assert "saved" in words[:14]
    assert "saved" not in words[16:]
    with open_map(path) as town:
        assert town.revision == 0
        assert town.interrupted()


def test_what_an_unfit_robot_remembers_is_dropped(path: Path) -> None:
    mapped(path)
    with open_map(path) as town, town.robot(CAMERA, name="r2", remembers=True) as robot:
        run(robot, numbered(AGAIN))
    assert robot.saving.state is SavingState.UNCOMMITTED
    assert "the stamps are the numbers of the frames" in robot.saving.reason
    assert "--seal" not in robot.saving.text()
    with open_map(path) as town:
        assert town.revision == 1
    assert not list(path.parent.glob("*-memory-*"))
