"""Rendering campaigns to disk."""

import multiprocessing
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engram.errors import ConfigError, IncompatibleError, SequenceError, WorkerError
from engram.frontend.frame import Landmarks
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.monitor import Monitor
from engram.robot.settings import Settings
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.motion_files import read_kitti_poses
from engram.sequences.opening import open_drive
from engram.sequences.sequence import first_pair_hash, session_of
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.session import SimulatedSequence
from engram_lab.town.simulating import campaign_folder, met_path, simulate
from engram_lab.truth import read_truth, truth_path


@pytest.fixture(scope="module")
def short() -> Campaign:
    """Three sessions of hamlet with a frame every ten metres."""
    whole = campaign_named("hamlet", seed=2)
    return replace(whole, sessions=whole.sessions[:3], spacing_m=10.0)


class Each(Monitor):
    """Calls a function with every word."""

    def __init__(self, call: Callable[[str], object]) -> None:
        self.call = call

    def advance(self, word: str = "") -> None:
        self.call(word)


@pytest.mark.long
def test_frame_logs_hold_every_frame_with_its_truth(short: Campaign, tmp_path: Path) -> None:
    words: list[str] = []
    report = simulate(short, tmp_path, workers=2, monitor=Each(words.append))
    assert report.rendered == 3
    assert len(words) == report.frames == 3 * len(SimulatedSequence(short, 0))
    for number, file in enumerate(report.files):
        log, truth = FrameLog(file), read_truth(file)
        assert truth is not None
        np.testing.assert_array_equal(log.stamps_ns, truth.stamps_ns)
        expected = SimulatedSequence(short, number).truth().world_from_cam[3].translation
        np.testing.assert_allclose(truth.world_from_cam[3].translation, expected, atol=1e-8)
        assert np.median([len(entry.frame.landmarks) for entry in log]) > 60
        log.close()


def test_what_a_drive_met_stands_beside_its_truth(tmp_path: Path) -> None:
    """Frame by frame; the head of the truth says what calibration left of the rig's errors."""
    rain = replace(campaign_named("hamlet", 2), spacing_m=30.0)
    report = simulate(rain, tmp_path, sessions=[4])
    target = Path(report.files[0])
    assert target.parent.name == "hamlet-standard-seed2-v7"
    rows = np.loadtxt(met_path(target), delimiter=",", skiprows=1)
    assert rows.shape == (report.frames, 5)
    rate, cover, sun_deg, exposure = rows[:, 0], rows[:, 1:3], rows[:, 3], rows[:, 4]
    assert 2 < rate.mean() < 6
    assert 0.1 < cover.mean() < 0.5
    assert np.all(sun_deg > 30)
    assert np.all(exposure > 0.2)
    residual = SimulatedSequence(rain, 4).drive.residual
    assert residual.text() in truth_path(target).read_text()


def test_a_log_gives_other_numbers_of_landmarks_without_rendering(tmp_path: Path) -> None:
    """Equal to the bit to a front-end that is asked for so many, and the report says how large."""
    few = replace(campaign_named("hamlet", 2), spacing_m=60.0)
    report = simulate(few, tmp_path, sessions=[0])
    target = Path(report.files[0])
    assert report.megabytes == pytest.approx(1e-6 * target.stat().st_size)
    for number in (100, 600):
        settings = FrontendConfig(landmarks=number)
        for logged, pair in zip(
            FrameLog(target, landmarks=number), SimulatedSequence(few, 0), strict=True
        ):
            wanted = Frontend(settings).extract(pair).landmarks
            for name in Landmarks.__slots__:
                np.testing.assert_array_equal(
                    getattr(logged.frame.landmarks, name), getattr(wanted, name)
                )
    ranked = FrameLog(target).ranked(1)
    assert ranked is not None
    assert len(ranked.ranks) > 800


def test_what_is_there_is_not_rendered_again(short: Campaign, tmp_path: Path) -> None:
    simulate(short, tmp_path, sessions=[1])
    before = Path(simulate(short, tmp_path, sessions=[1]).files[0]).read_bytes()
    words: list[str] = []
    report = simulate(short, tmp_path, sessions=[1], monitor=Each(words.append))
    assert (report.rendered, report.already_there) == (0, 1)
    assert len(words) == len(SimulatedSequence(short, 1))
    assert Path(report.files[0]).read_bytes() == before


def test_a_log_of_other_frames_is_rendered_again(tmp_path: Path) -> None:
    """Such as that of a drive that began elsewhere; the words are people's."""
    few = replace(campaign_named("hamlet", 2), spacing_m=60.0)
    simulate(few, tmp_path, sessions=[0])
    words: list[str] = []
    later = replace(few, begins_m=60.0)
    report = simulate(later, tmp_path, sessions=[0], monitor=Each(words.append))
    assert (report.rendered, report.already_there) == (1, 0)
    assert words == ["Mon 08:30, clear"] * len(SimulatedSequence(few, 0).drive.poses[1:])
    np.testing.assert_array_equal(
        FrameLog(report.files[0]).stamps_ns, SimulatedSequence(few, 0).truth().stamps_ns[1:]
    )


@pytest.mark.long
def test_a_session_that_is_named_twice_is_rendered_once(short: Campaign, tmp_path: Path) -> None:
    words: list[str] = []
    report = simulate(short, tmp_path, sessions=[2, 0, 2], monitor=Each(words.append))
    assert report.rendered == 2
    assert [Path(file).name[:3] for file in report.files] == ["000", "002"]
    assert len(words) == report.frames == 2 * len(SimulatedSequence(short, 0))


def test_what_another_front_end_made_is_not_taken_for_this_ones(
    short: Campaign, tmp_path: Path
) -> None:
    simulate(short, tmp_path, sessions=[1])
    other = Settings(frontend=FrontendConfig(landmarks=100))
    with pytest.raises(IncompatibleError, match="was rendered with another version"):
        simulate(short, tmp_path, sessions=[1], settings=other)


@pytest.mark.long
def test_odometry_that_has_changed_is_run_over_what_was_rendered(
    short: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log becomes what it would be if it were rendered now, and nothing is rendered."""
    near = replace(short, spacing_m=2.5, sessions=short.sessions[:1])
    other = Settings(odometry=replace(Settings().odometry, min_inliers=21))
    (file,) = simulate(near, tmp_path / "old", settings=other).files
    (wanted,) = simulate(near, tmp_path / "new").files
    monkeypatch.setattr("engram_lab.town.simulating._render", None)
    again = campaign_folder(tmp_path / "old", near)
    report = simulate(near, tmp_path / "old")
    assert (report.rendered, report.already_there, report.files) == (0, 1, [file])
    assert contents(file) == contents(wanted)
    assert sorted(path.name for path in again.iterdir()) == sorted(
        path.name for path in Path(wanted).parent.iterdir()
    )
    before = Path(file).read_bytes()
    assert simulate(near, tmp_path / "old").already_there == 1
    assert Path(file).read_bytes() == before


@pytest.mark.long
@pytest.mark.parametrize("landmarks", [100, 3000])
def test_logs_without_a_second_look_stay_where_none_would_be_taken(
    landmarks: int, short: Campaign, tmp_path: Path
) -> None:
    """Only where a frame lacks landmarks the session is rendered again."""
    near = replace(short, spacing_m=2.5, sessions=short.sessions[:1])
    first, both = (
        Settings(frontend=FrontendConfig(landmarks=landmarks, second_threshold=second))
        for second in (0, 3)
    )
    simulate(near, tmp_path / "old", settings=first)
    report = simulate(near, tmp_path / "old", settings=both)
    assert (report.rendered, report.already_there) == ((0, 1) if landmarks == 100 else (1, 0))
    (wanted,) = simulate(near, tmp_path / "new", settings=both).files
    assert contents(report.files[0]) == contents(wanted)


@pytest.mark.long
def test_logs_of_before_sides_were_compared_stay(short: Campaign, tmp_path: Path) -> None:
    """Both cameras of a rendered rig have one exposure: nothing is measured otherwise."""
    near = replace(short, spacing_m=2.5, sessions=short.sessions[:1])
    before = Settings(frontend=FrontendConfig(side_difference=0))
    simulate(near, tmp_path / "old", settings=before)
    report = simulate(near, tmp_path / "old")
    assert (report.rendered, report.already_there) == (0, 1)
    (wanted,) = simulate(near, tmp_path / "new").files
    assert contents(report.files[0]) == contents(wanted)


def contents(file: str) -> list[tuple[object, ...]]:
    """The header of a frame log and all its frames."""
    log = FrameLog(file)
    rows: list[tuple[object, ...]] = [(log.complete, log.header.to_json())]
    for number, one in enumerate(log):
        step = one.odometry
        motion = None if step.prev_from_curr is None else step.prev_from_curr.matrix().tobytes()
        covariance = None if step.covariance is None else step.covariance.tobytes()
        landmarks = one.frame.landmarks.descriptors.tobytes()
        about = (log.pair_hash(number), one.frame.stamp_ns, step.status, step.inliers)
        rows.append((*about, motion, covariance, landmarks))
    log.close()
    return rows


@pytest.mark.long
def test_a_killed_run_is_taken_up_again(short: Campaign, tmp_path: Path) -> None:
    class Killed(BaseException):
        pass

    count = 0

    def kill(_: str) -> None:
        nonlocal count
        count += 1
        if count == 7:
            raise Killed

    with pytest.raises(Killed):
        simulate(short, tmp_path, sessions=[0], monitor=Each(kill))
    report = simulate(short, tmp_path, sessions=[0])
    log = FrameLog(report.files[0])
    assert log.complete
    assert len(log) == len(SimulatedSequence(short, 0))
    log.close()


@pytest.mark.long
def test_a_worker_that_dies_is_told_and_the_same_call_goes_on(
    short: Campaign, tmp_path: Path
) -> None:
    def kill(_: str) -> None:
        for child in multiprocessing.active_children():
            child.kill()

    with pytest.raises(WorkerError, match=r"died 4 times.* fewer workers"):
        simulate(short, tmp_path, workers=2, monitor=Each(kill))
    report = simulate(short, tmp_path, workers=2)
    assert report.rendered + report.already_there == 3
    for file in report.files:
        log = FrameLog(file)
        assert log.complete
        assert len(log) == len(SimulatedSequence(short, 0))
        log.close()


@pytest.mark.long
def test_images_in_kitti_layout_read_back_as_rendered(short: Campaign, tmp_path: Path) -> None:
    one = replace(short, spacing_m=30.0)
    folder = Path(simulate(one, tmp_path, images=True, sessions=[2]).files[0])
    sequence = open_drive(folder)
    rendered = SimulatedSequence(one, 2)
    for name in ("fx", "fy", "cx", "cy", "baseline_m", "width", "height"):
        assert getattr(sequence.camera, name) == pytest.approx(getattr(rendered.camera, name))
    for read, made in zip(sequence, rendered, strict=True):
        np.testing.assert_array_equal(read.left, made.left)
        np.testing.assert_array_equal(read.right, made.right)
    truth = read_kitti_poses(folder.parent.parent / "poses" / f"{folder.name}.txt", range(4))
    poses = rendered.drive.world_from_cams()
    expected = (poses[0].inverse() @ poses[2]).translation
    np.testing.assert_allclose(truth.world_from_cam[2].translation, expected, atol=1e-6)


@pytest.mark.long
def test_a_drive_read_twice_is_one_session_and_two_towns_are_two_robots(short: Campaign) -> None:
    def identity(campaign: Campaign) -> object:
        sequence = SimulatedSequence(campaign, 0)
        first = next(iter(sequence))
        return session_of(sequence.info, sequence.camera, first.stamp_ns, first_pair_hash(first)).id

    assert identity(short) == identity(short)
    assert identity(short) != identity(replace(short, seed=3))


def test_bad_wishes_are_refused(short: Campaign, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="workers is 0"):
        simulate(short, tmp_path, workers=0)
    with pytest.raises(ConfigError, match="sessions 0 to 2, not 3"):
        simulate(short, tmp_path, sessions=[3])
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(SequenceError, match="cannot be written"):
        simulate(short, tmp_path / "file", sessions=[0])


def test_campaigns_are_kept_apart_by_name_seed_size_and_version(tmp_path: Path) -> None:
    names = {
        campaign_folder(tmp_path, campaign_named(name, seed)).name
        for name in ("hamlet", "begbroke24h")
        for seed in (1, 2)
    }
    assert len(names) == 4
    by_day, whole = campaign_named("begbroke"), campaign_named("begbroke24h")
    assert campaign_folder(tmp_path, by_day) == campaign_folder(tmp_path, whole)
    assert set(by_day.sessions) < set(whole.sessions)
    assert by_day.first_day == whole.first_day
