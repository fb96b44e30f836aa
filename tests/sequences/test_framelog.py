"""Frame logs: what is written is read back, whatever happens in between."""

import multiprocessing
import os
import signal
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from engram.errors import (
    ConfigError,
    EngramError,
    FormatVersionError,
    IncompatibleError,
    InputError,
    MapCorruptError,
    MapError,
    MapLockedError,
    SequenceError,
    StorageFullError,
)
from engram.frontend.frame import Landmarks
from engram.frontend.ranked import RankedLandmarks
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.model import Clock
from engram.odometry.step import OdometryStatus
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram.sequences.sequence import FrameRange, LoggedFrame

from .synthetic import (
    PAIRS,
    PERIOD_NS,
    START_NS,
    interrupt_transaction,
    log_header,
    logged,
    name_super_journal,
    only_engram_errors,
    pair_hash,
    picture,
    stamp_ns,
    write_log,
)


def assert_same_frame(found: LoggedFrame, wanted: LoggedFrame) -> None:
    for name in ("stamp_ns", "camera", "descriptor", "frontend", "status"):
        assert getattr(found.frame, name) == getattr(wanted.frame, name)
    for name in type(wanted.frame.landmarks).__slots__:
        np.testing.assert_array_equal(
            getattr(found.frame.landmarks, name), getattr(wanted.frame.landmarks, name)
        )
    assert found.odometry.status is wanted.odometry.status
    assert found.odometry.inliers == wanted.odometry.inliers
    if wanted.odometry.prev_from_curr is not None:
        np.testing.assert_array_equal(
            found.odometry.prev_from_curr.matrix(), wanted.odometry.prev_from_curr.matrix()
        )
        np.testing.assert_array_equal(found.odometry.covariance, wanted.odometry.covariance)


def test_what_is_written_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    log = open_drive(write_log(tmp_path / "a.framelog"))
    assert isinstance(log, FrameLog)
    frames = list(log)
    assert len(log) == len(frames) == PAIRS
    for index, frame in enumerate(frames):
        assert_same_frame(frame, logged(index))
        # A thumbnail is for people: JPEG of noise, so only its shape is exact.
        assert frame.frame.thumbnail.shape == picture(index, 0).shape
    assert log.complete
    assert log.header.to_json() == log_header().to_json()
    assert (log.info.robot, log.info.zone, log.info.format) == (
        "husky",
        "Europe/Berlin",
        "framelog",
    )
    assert log.first_pair_hash == pair_hash(0)


def ranked(index: int) -> RankedLandmarks:
    """A frame's landmarks with every second one of them again, of later ranks."""
    own = logged(index).frame.landmarks
    count = len(own)
    more = Landmarks(*(getattr(own, name)[::2] for name in Landmarks.__slots__))
    places = np.random.default_rng(index).permutation(count + len(more))
    ranks = np.empty(len(places), np.uint16)
    ranks[np.sort(places[:count])] = 3 * np.random.default_rng(7).permutation(count)
    ranks[np.sort(places[count:])] = 3 * count + np.arange(len(more))
    return RankedLandmarks.joined(own, more, ranks)


def write_ranked(path: Path) -> Path:
    with FrameLogWriter(path, log_header()) as writer:
        for index in range(PAIRS):
            writer.append(logged(index), pair_hash(index), ranked(index))
    return path


def test_further_landmarks_are_kept_beside_the_frame_s_own(tmp_path: Path) -> None:
    path = write_ranked(tmp_path / "a.framelog")
    log, fewer = FrameLog(path), FrameLog(path, landmarks=4)
    for index in range(PAIRS):
        assert_same_frame(log.read(index), logged(index))
        found, wanted = log.ranked(index), ranked(index)
        assert found is not None
        np.testing.assert_array_equal(found.ranks, wanted.ranks)
        for name in Landmarks.__slots__:
            chosen, first = (getattr(one, name) for one in (found.landmarks, wanted.landmarks))
            np.testing.assert_array_equal(chosen, first)
        assert len(fewer.read(index).frame.landmarks) == len(wanted.first(4)) > 0
    assert FrameLog(write_log(tmp_path / "b.framelog")).ranked(0) is None


def test_landmarks_of_a_frame_that_leaves_some_out_are_not_kept(tmp_path: Path) -> None:
    own = logged(0).frame.landmarks
    rest = Landmarks(*(getattr(own, name)[1:] for name in Landmarks.__slots__))
    frame = replace(logged(0).frame, landmarks=rest, left_out=1)
    with FrameLogWriter(tmp_path / "a.framelog", log_header()) as writer:
        writer.append(replace(logged(0), frame=frame), pair_hash(0), ranked(0))
    assert FrameLog(tmp_path / "a.framelog").ranked(0) is None


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE more SET ranks = zeroblob(length(ranks)) WHERE number = 2",
        "UPDATE more SET landmarks = (SELECT landmarks FROM frames WHERE number = 1)",
        "UPDATE more SET number = number + 10 WHERE number = 2; "
        "UPDATE more SET number = 2 WHERE number = 3",
    ],
)
def test_damaged_further_landmarks_are_named(tmp_path: Path, damage: str) -> None:
    path = write_ranked(tmp_path / "a.framelog")
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(damage)
    log = FrameLog(path)
    assert_same_frame(log.read(2), logged(2))
    with pytest.raises(MapCorruptError, match="frame 2 of the frame log: its further landmarks"):
        log.ranked(2)


def test_a_finished_log_is_one_file(tmp_path: Path) -> None:
    write_log(tmp_path / "a.framelog")
    assert [path.name for path in tmp_path.iterdir()] == ["a.framelog"]


def test_a_log_is_read_from_the_middle(tmp_path: Path) -> None:
    log = FrameLog(write_log(tmp_path / "a.framelog"))
    assert_same_frame(log.read(4), logged(4))
    assert_same_frame(log.read(-1), logged(PAIRS - 1))
    with pytest.raises(IndexError):
        log.read(PAIRS)


def test_steps_are_composed_over_skipped_frames(tmp_path: Path) -> None:
    log = open_drive(write_log(tmp_path / "a.framelog"), frames="1::2")
    frames = list(log)
    assert [frame.frame.stamp_ns for frame in frames] == [stamp_ns(1), stamp_ns(3), stamp_ns(5)]
    assert frames[0].odometry.status is OdometryStatus.FIRST
    first, second = logged(2).odometry, logged(3).odometry
    motion = first.prev_from_curr @ second.prev_from_curr
    np.testing.assert_allclose(
        frames[1].odometry.prev_from_curr.matrix(), motion.matrix(), atol=1e-14
    )
    np.testing.assert_allclose(
        frames[1].odometry.covariance,
        propagate_covariance(first.prev_from_curr, first.covariance, second.covariance),
        atol=1e-18,
    )
    assert frames[1].odometry.inliers == 102
    assert log.first_pair_hash == pair_hash(1)


def test_steps_of_three_compose_to_the_whole_way(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.framelog")
    last = list(open_drive(path, frames="0::5"))[-1].odometry
    whole = SE3.identity()
    for index in range(1, 6):
        whole = whole @ logged(index).odometry.prev_from_curr
    np.testing.assert_allclose(last.prev_from_curr.matrix(), whole.matrix(), atol=1e-13)


@pytest.mark.parametrize("failed", [2, 3, 4])
def test_a_failed_step_makes_the_composed_step_fail(tmp_path: Path, failed: int) -> None:
    frames = [
        logged(index, OdometryStatus.NO_CONSENSUS if index == failed else None)
        for index in range(PAIRS)
    ]
    path = write_log(tmp_path / "a.framelog", frames)
    composed = [frame.odometry for frame in open_drive(path, frames="1::3")]
    assert composed[1].status is OdometryStatus.NO_CONSENSUS
    assert composed[1].prev_from_curr is None
    assert composed[1].inliers == 0


@pytest.mark.parametrize("frames", ["0::2", "0::3", "1::2"])
def test_no_motion_is_lost_across_an_unusable_frame(tmp_path: Path, frames: str) -> None:
    # Frame 3 is dark: step 4 spans it, from frame 2.
    recorded = [
        logged(index, OdometryStatus.UNUSABLE_FRAME if index == 3 else None)
        for index in range(PAIRS)
    ]
    path = write_log(tmp_path / "a.framelog", recorded)
    chosen = [int(index) for index in np.arange(PAIRS)[FrameRange.parse(frames).indices(PAIRS)]]
    log = open_drive(path, frames=frames)
    whole = SE3.identity()
    for entry in log:
        if entry.odometry.prev_from_curr is not None:
            whole = whole @ entry.odometry.prev_from_curr
    expected = SE3.identity()
    last_usable = max(index for index in chosen if index != 3)
    for index in range(chosen[0] + 1, last_usable + 1):
        if index != 3:
            expected = expected @ recorded[index].odometry.prev_from_curr
    np.testing.assert_allclose(whole.matrix(), expected.matrix(), atol=1e-13)
    by_index = [log.read(i).odometry.status for i in range(len(log))]
    assert by_index == [entry.odometry.status for entry in log]


def test_a_start_time_makes_a_relative_clock_utc(tmp_path: Path) -> None:
    path = tmp_path / "a.framelog"
    write_log(path)
    with pytest.raises(ConfigError, match="UTC already"):
        open_drive(path, recorded_at="2020-01-01T00:00:00Z")


def test_recording_goes_on_where_it_stopped(tmp_path: Path) -> None:
    path = tmp_path / "a.framelog"

    def record_until_interrupted() -> None:
        with FrameLogWriter(path, log_header()) as writer:
            for index in range(3):
                writer.append(logged(index), pair_hash(index))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record_until_interrupted()
    interrupted = FrameLog(path)
    assert len(interrupted) == 3
    assert not interrupted.complete
    with FrameLogWriter(path, log_header()) as writer:
        assert writer.recorded == 3
        assert writer.last_stamp_ns == stamp_ns(2)
        for index in range(3, PAIRS):
            writer.append(logged(index), pair_hash(index))
    log = FrameLog(path)
    assert log.complete
    for index, frame in enumerate(log):
        assert_same_frame(frame, logged(index))


def _record_until_killed(path: Path) -> None:
    writer = FrameLogWriter(path, log_header(), checkpoint_every=2)
    for index in range(5):
        writer.append(logged(index), pair_hash(index))
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_recording_keeps_its_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "a.framelog"
    process = multiprocessing.get_context("spawn").Process(
        target=_record_until_killed, args=(path,)
    )
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    log = FrameLog(path)
    assert len(list(log)) == 4
    assert not log.complete
    with FrameLogWriter(path, log_header()) as writer:
        assert writer.recorded == 4


def test_an_interrupted_transaction_is_undone(tmp_path: Path) -> None:
    """A recorder that ends folds its log in; a kill or a power cut then leaves a journal."""
    path = tmp_path / "cut" / "a.framelog"
    whole = write_log(tmp_path / "a.framelog", [logged(index) for index in range(40)])
    interrupt_transaction(whole, "frames", path)
    assert path.read_bytes() != whole.read_bytes()
    assert len(list(FrameLog(path))) == 40
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_a_journal_deletes_no_file_that_it_names(tmp_path: Path) -> None:
    path, named = tmp_path / "cut" / "a.framelog", tmp_path / "photographs.txt"
    whole = write_log(tmp_path / "a.framelog", [logged(index) for index in range(40)])
    interrupt_transaction(whole, "frames", path)
    name_super_journal(path, named)
    named.write_text("mine")
    with pytest.raises(MapCorruptError, match="names another file"):
        FrameLog(path)
    assert named.read_text() == "mine"


def test_nobody_can_undo_a_transaction_on_read_only_media(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "cut" / "a.framelog"
    interrupt_transaction(
        write_log(tmp_path / "a.framelog", [logged(index) for index in range(40)]), "frames", path
    )
    monkeypatch.setattr(os, "access", lambda _, mode: mode != os.W_OK)  # root writes anywhere
    with pytest.raises(MapError, match=r"a\.framelog-journal undoes: copy both"):
        FrameLog(path)


def test_a_log_is_read_while_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "a.framelog"
    with FrameLogWriter(path, log_header(), checkpoint_every=2) as writer:
        for index in range(3):
            writer.append(logged(index), pair_hash(index))
        assert len(list(FrameLog(path))) == 2


def test_two_writers_the_second_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.framelog"
    with FrameLogWriter(path, log_header()) as writer:
        writer.append(logged(0), pair_hash(0))
        with pytest.raises(MapLockedError, match="another process writes"):
            FrameLogWriter(path, log_header())
        writer.append(logged(1), pair_hash(1))
    assert len(FrameLog(path)) == 2


@pytest.mark.parametrize("change", [{"frontend": "other settings"}, {"frames": "0::2"}])
def test_another_drive_is_not_appended(tmp_path: Path, change: dict) -> None:
    path = write_log(tmp_path / "a.framelog")
    with pytest.raises(IncompatibleError, match="another"):
        FrameLogWriter(path, log_header(**change))


def test_frames_of_an_earlier_run_are_known(tmp_path: Path) -> None:
    path = tmp_path / "a.framelog"
    with FrameLogWriter(path, log_header()) as writer:
        for index in (0, 2):
            assert not writer.holds(stamp_ns(index), pair_hash(index))
            writer.append(logged(index), pair_hash(index))
    with FrameLogWriter(path, log_header()) as writer:
        assert writer.holds(stamp_ns(0), pair_hash(0))
        assert not writer.holds(stamp_ns(3), pair_hash(3))
        with pytest.raises(IncompatibleError, match="no frame"):
            writer.holds(stamp_ns(1), pair_hash(1))
        with pytest.raises(IncompatibleError, match="other images"):
            writer.holds(stamp_ns(2), pair_hash(0))


def test_a_full_disk_loses_nothing_that_was_committed(tmp_path: Path) -> None:
    path = tmp_path / "a.framelog"
    writer = FrameLogWriter(path, log_header(), checkpoint_every=2)
    for index in range(2):
        writer.append(logged(index), pair_hash(index))
    pages = writer._connection.exec_driver_sql("PRAGMA page_count").scalar()
    writer._connection.exec_driver_sql(f"PRAGMA max_page_count = {pages}")

    def record_the_rest() -> None:
        for index in range(2, PAIRS):
            writer.append(logged(index), pair_hash(index))

    with pytest.raises(StorageFullError, match="up to the last checkpoint is safe"):
        record_the_rest()
    with pytest.raises(InputError, match="closed"):
        writer.append(logged(5), pair_hash(5))
    writer.close()
    log = FrameLog(path)
    assert len(list(log)) in {2, 4}  # as many checkpoints as the free pages allowed
    assert not log.complete
    with FrameLogWriter(path, log_header()) as again:
        assert again.recorded == len(log)


def test_a_log_has_no_colours(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'blue'"):
        open_drive(write_log(tmp_path / "a.framelog"), channel="blue")


def test_frames_must_rise_and_fit(tmp_path: Path) -> None:
    with FrameLogWriter(tmp_path / "a.framelog", log_header()) as writer:
        writer.append(logged(1), pair_hash(1))
        with pytest.raises(InputError, match="not after"):
            writer.append(logged(1), pair_hash(1))
    with (
        FrameLogWriter(tmp_path / "b.framelog", log_header(frontend="x")) as writer,
        pytest.raises(InputError, match="another frontend"),
    ):
        writer.append(logged(0), pair_hash(0))


def test_what_is_no_frame_log_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "a.framelog"
    text.write_text("hello, this is no database at all, but it is long enough to be one" * 20)
    with pytest.raises(SequenceError, match="not a frame log"):
        open_drive(text)
    with pytest.raises(SequenceError, match="not a frame log"):
        FrameLogWriter(text, log_header())
    other = tmp_path / "b.framelog"
    with sqlite3.connect(other) as database:
        database.execute("CREATE TABLE frames (number INTEGER)")
    database.close()
    with pytest.raises(SequenceError, match="not a frame log"):
        open_drive(other)
    empty = tmp_path / "c.framelog"
    empty.touch()
    with pytest.raises(SequenceError, match="not a frame log"):
        open_drive(empty)
    with pytest.raises(SequenceError, match="there is no such"):
        open_drive(tmp_path / "d.framelog", format="framelog")


def test_a_newer_format_is_refused(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.framelog")
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA user_version = 99")
    database.close()
    with pytest.raises(FormatVersionError, match=r"format 99.*upgrade Engram"):
        open_drive(path)


@pytest.mark.parametrize(
    "hostile",
    [
        "CREATE VIEW others AS WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n FROM r) "
        "SELECT * FROM r",
        "CREATE TRIGGER t AFTER UPDATE ON log BEGIN DELETE FROM frames; END",
        "DROP TABLE frames",
        "DROP TABLE frames; CREATE TABLE frames (number, stamp_ns, status, pair_hash, "
        "odometry_status, inliers, prev_from_curr, covariance, digest, landmarks, thumbnail); "
        "INSERT INTO frames VALUES (0, 'noon', 1, 2, 3, 4, 5, 6, 7, 8, 9)",
        "DROP TABLE frames; CREATE TABLE frames (number, stamp_ns, status, pair_hash, "
        "odometry_status, inliers, prev_from_curr, covariance, digest, landmarks, thumbnail); "
        "INSERT INTO frames VALUES (0, 1, 1, 2, 3, 4, 5, 6, 7, 8, 9)",
        "DELETE FROM log",
    ],
)
def test_a_made_up_file_is_refused(tmp_path: Path, hostile: str) -> None:
    path = write_log(tmp_path / "a.framelog")
    with sqlite3.connect(path) as database:
        database.executescript(hostile)
    database.close()
    with pytest.raises(MapCorruptError, match=r"a\.framelog"):
        list(open_drive(path))


@pytest.mark.parametrize("gone", [1, PAIRS - 1])
def test_a_log_that_lost_its_last_frames_is_told(tmp_path: Path, gone: int) -> None:
    path = write_log(tmp_path / "a.framelog")
    change(path, "DELETE FROM frames WHERE number >= ?", PAIRS - gone)
    with pytest.raises(MapCorruptError, match=f"{PAIRS - gone} frames, and was recorded with"):
        FrameLog(path)


@pytest.mark.parametrize("complete", [0, 1, PAIRS + 1])
def test_a_count_of_frames_that_was_changed_is_told(tmp_path: Path, complete: int) -> None:
    path = write_log(tmp_path / "a.framelog")
    change(path, "UPDATE log SET complete = ?", complete)
    with pytest.raises(MapCorruptError, match="does not match its hash"):
        FrameLog(path)


def change(path: Path, statement: str, *values: object) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(statement, values)


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.95])
def test_a_log_cut_short_is_told(tmp_path: Path, keep: float) -> None:
    path = write_log(tmp_path / "a.framelog")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(EngramError, match=r"a\.framelog"):
        list(open_drive(path))


DAMAGES = [
    "UPDATE frames SET landmarks = CAST(substr(landmarks, 1, 200) AS BLOB) WHERE number = 2",
    "UPDATE frames SET thumbnail = x'ffd8' WHERE number = 2",
    "UPDATE frames SET stamp_ns = stamp_ns + 1 WHERE number = 2",
    "UPDATE frames SET landmarks = (SELECT landmarks FROM frames WHERE number = 3) "
    "WHERE number = 2",
    "UPDATE frames SET inliers = 7 WHERE number = 2",
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_frame_is_named_or_skipped(tmp_path: Path, damage: str) -> None:
    path = write_log(tmp_path / "a.framelog")
    with sqlite3.connect(path) as database:
        database.execute(damage)
    database.close()
    with pytest.raises(MapCorruptError, match=r"a\.framelog.*frame 2"):
        list(open_drive(path))
    log = open_drive(path, skip_bad=True)
    assert [frame.frame.stamp_ns for frame in log] == [stamp_ns(i) for i in (0, 1, 3, 4, 5)]
    assert log.skipped == 1
    assert "frame 2" in log.skipped_reasons[0]


def test_a_gap_in_the_numbers_is_told(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.framelog")
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM frames WHERE number = 2")
    database.close()
    with pytest.raises(MapCorruptError, match="gaps"):
        open_drive(path)


@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
@example(place=0.0859375, flip=128)  # reached the schema, where the driver's own message broke
def test_a_flipped_byte_gives_our_errors_or_the_same_frames(
    tmp_path_factory: pytest.TempPathFactory, place: float, flip: int
) -> None:
    path = write_log(tmp_path_factory.mktemp("flip") / "a.framelog")
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= flip
    path.write_bytes(content)
    read: list[LoggedFrame] = []
    error = only_engram_errors(lambda: read.extend(open_drive(path)))
    for index, frame in enumerate(read):
        assert_same_frame(frame, logged(index))
    assert error is not None or len(read) == PAIRS


def test_start_shifts_the_stamps_of_a_log_without_a_clock(tmp_path: Path) -> None:
    header = log_header(info=replace(log_header().info, clock=Clock.RELATIVE))
    path = tmp_path / "a.framelog"
    with FrameLogWriter(path, header) as writer:
        for index in range(PAIRS):
            writer.append(logged(index), pair_hash(index))
    log = open_drive(path, recorded_at=START_NS + 5, frames="2:4")
    assert log.info.clock is Clock.UTC
    wanted = [START_NS + 5 + index * PERIOD_NS for index in (2, 3)]
    assert [frame.frame.stamp_ns for frame in log] == wanted
    assert log.stamps_ns.tolist() == wanted
