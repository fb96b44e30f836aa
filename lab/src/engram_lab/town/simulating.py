"""Rendering a campaign to disk: frame logs with truth, or images in KITTI's layout."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from platformdirs import user_cache_path

from engram.config import config_hash
from engram.errors import (
    ConfigError,
    IncompatibleError,
    SequenceError,
    StorageFullError,
    storage_full,
)
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.se3 import SE3
from engram.monitor import QUIET, Advancing, Monitor, write_whole
from engram.odometry.odometry import Odometry
from engram.processes import run_in_processes
from engram.robot.mapping import extract_log
from engram.robot.settings import Settings
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.motion_files import write_tum
from engram.sequences.sequence import LoggedFrame
from engram_lab.town.camera_model import Met
from engram_lab.town.campaigns import WORLD_VERSION, Campaign
from engram_lab.town.session import SimulatedDrive, SimulatedSequence
from engram_lab.truth import truth_path

MOST_LANDMARKS = 2000  # of a frame that a log keeps, so that other numbers need no rendering


class Upkeep(Enum):
    """Result of checking a log."""

    KEPT = "kept"
    REWRITTEN = "rewritten"
    # Its front-end took no second look, which some of its frames would get now.
    OUTDATED = "outdated"


def bring_up_to_date(path: Path, settings: Settings) -> Upkeep:
    """Rewrites a log of older odometry, or of a front-end that gives the same landmarks.

    Odometry is run over the landmarks again. A log of a front-end without a second look holds what
    one with it gives, if no frame lacks landmarks; only then it becomes one of the other. One of a
    front-end that compared the sides as they are holds what is measured now: both cameras of a
    rendered rig have one exposure. The log is replaced in one step; frames, hashes of images and
    the drive's identity stay.
    """
    log = FrameLog(path)
    try:
        frontend, odometry = Frontend(settings.frontend).hash, config_hash(settings.odometry)
        outdated = False
        if log.header.frontend not in known_frontends(settings):
            raise IncompatibleError(
                f"{path}: was rendered with another version or other settings of the front-end "
                f"({log.header.frontend}, now {frontend}); give another --out, or remove the "
                "folder to render again"
            )
        looks_twice = settings.frontend.second_threshold > 0
        once = looks_twice and log.header.frontend in _looking_once(settings)
        if once and _lacks_landmarks(log, settings):
            outdated, frontend = True, log.header.frontend
        header = replace(log.header, odometry=odometry, frontend=frontend)
        if header != log.header:
            with write_whole(path) as draft:
                _rewrite(log, draft, header, settings)
    finally:
        log.close()
    if outdated:
        return Upkeep.OUTDATED
    return Upkeep.KEPT if header == log.header else Upkeep.REWRITTEN


def known_frontends(settings: Settings) -> set[str]:
    """Hashes of the front-end, and of those before it whose logs can be brought up to date."""
    return _frontends(settings.frontend) | _looking_once(settings)


def _looking_once(settings: Settings) -> set[str]:
    """Of the same front-end without its second look."""
    return _frontends(replace(settings.frontend, second_threshold=0))


def _frontends(config: FrontendConfig) -> set[str]:
    """Of a front-end, and of that which compared the sides as they are."""
    return {Frontend(one).hash for one in (config, replace(config, side_difference=0))}


def _lacks_landmarks(log: FrameLog, settings: Settings) -> bool:
    wanted = settings.frontend.landmarks_for(log.camera.width * log.camera.height)
    return any(len(one.frame.landmarks.pixels) < wanted for one in log)


def _rewrite(log: FrameLog, draft: Path, header: FrameLogHeader, settings: Settings) -> None:
    engine = Odometry(settings.odometry)
    with FrameLogWriter(draft, header) as writer:
        for index, logged in enumerate(log):
            frame = replace(logged.frame, frontend=header.frontend)
            step = engine.step(frame)
            writer.append(LoggedFrame(frame, step), log.pair_hash(index), log.ranked(index))


@dataclass(slots=True)
class SimulateReport:
    """What rendering a campaign came to."""

    folder: str
    rendered: int = 0
    already_there: int = 0
    frames: int = 0
    megabytes: float = 0.0  # of all sessions asked for
    files: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """What ``simulate --json`` prints."""
        return asdict(self)

    def text(self) -> str:
        """For people."""
        return (
            f"{self.rendered} sessions rendered ({self.frames} pairs), {self.already_there} were "
            f"there already, {self.megabytes:.1f} MB, in {self.folder}"
        )


@dataclass(frozen=True, slots=True)
class _Task:
    campaign: Campaign
    session: int
    target: Path
    images: bool
    settings: Settings


def campaigns_folder() -> Path:
    """$ENGRAM_CAMPAIGNS, or a folder in the user's cache: rendered once, read often."""
    named = os.environ.get("ENGRAM_CAMPAIGNS")
    return Path(named) if named else user_cache_path("engram") / "campaigns"


def campaign_folder(out: Path, campaign: Campaign) -> Path:
    """Where a campaign's sessions stand below `out`: by campaign, seed, size and world version."""
    name = f"{campaign.home}-{campaign.size.value}-seed{campaign.seed}-v{WORLD_VERSION}"
    return out / name


def simulate(
    campaign: Campaign,
    out: Path,
    *,
    images: bool = False,
    sessions: Sequence[int] | None = None,
    workers: int = 1,
    settings: Settings | None = None,
    monitor: Monitor = QUIET,
) -> SimulateReport:
    """Renders a campaign's sessions that are not there yet.

    Odometry that has changed is run again over the landmarks of sessions that are there. Of logs of
    before the front-end's second look only those are rendered again in which a frame would get one.

    Frame logs stand as `NAME.framelog` with `NAME.truth.txt` beside them; images in KITTI's
    odometry layout, `sequences/NN` and `poses/NN.txt`. A killed run is resumed by the same call:
    whole sessions are kept, a session that was begun is rendered again.

    Args:
        sessions: numbers of the sessions wanted, each once however often it is named; None for
            all.
        workers: processes; each renders one session at a time and holds about 0.7 GB.
        settings: of front-end and odometry; None for the defaults.
    """
    if workers < 1:
        raise ConfigError(f"workers is {workers}, must be >= 1")
    folder = campaign_folder(out, campaign)
    report = SimulateReport(str(folder))
    _make_folder(folder)
    every = range(len(campaign.sessions))
    numbers = every if sessions is None else sorted(set(sessions))
    asked = [_task(campaign, one, folder, images, settings or Settings()) for one in numbers]
    report.files = [str(task.target) for task in asked]
    tasks = [task for task in asked if not _is_done(task)]
    lengths = {task.session: len(SimulatedSequence(campaign, task.session)) for task in asked}
    with monitor.stage(f"simulate {campaign.name}", sum(lengths.values())) as part:
        for task in asked:
            if task not in tasks:
                for _ in range(lengths[task.session]):
                    part.advance(campaign.session(task.session).words)
        if workers == 1 or len(tasks) < 2:
            for task in tasks:
                _render(task, part)
        else:
            # Sessions of one process share the town, which takes seconds to make.
            shares = {f"share {first + 1}": tasks[first::workers] for first in range(workers)}
            run_in_processes(_render_share, shares, workers, part, lambda *_: None)
    report.frames = sum(lengths[task.session] for task in tasks)
    report.megabytes = 1e-6 * sum(_size(task.target) for task in asked)
    report.rendered, report.already_there = len(tasks), len(asked) - len(tasks)
    return report


def _size(target: Path) -> int:
    """Bytes of a log, or of a folder of images."""
    files = target.rglob("*") if target.is_dir() else [target]
    return sum(file.stat().st_size for file in files if file.is_file())


def _task(campaign: Campaign, number: int, folder: Path, images: bool, settings: Settings) -> _Task:
    plan = campaign.session(number)
    target = (
        folder / "images" / "sequences" / f"{plan.number:03d}"
        if images
        else folder / f"{plan.name}.framelog"
    )
    return _Task(campaign, number, target, images, settings)


def _is_done(task: _Task) -> bool:
    """The last file that is written of a session says that it is whole."""
    if task.images:
        return _poses_path(task.target).exists()
    if not (task.target.exists() and truth_path(task.target).exists()):
        return False
    log = FrameLog(task.target)
    log.close()
    drive = SimulatedDrive(task.campaign, task.session)
    wanted_ns = [drive.stamp_ns(frame) for frame in range(len(drive))]
    # A log may be of other frames: those of another spacing, or of drives that begin elsewhere.
    if not log.complete or log.stamps_ns.tolist() != wanted_ns:
        return False
    # A campaign is of one make, or its sessions do not compare.
    return bring_up_to_date(task.target, task.settings) is not Upkeep.OUTDATED


def _is_outdated(target: Path) -> bool:
    """Whether a whole log is there, which a session that is rendered again replaces."""
    if not target.exists():
        return False
    try:
        log = FrameLog(target)
    except SequenceError:  # its worker died before the first frame
        return False
    log.close()
    return log.complete


def _render_share(tasks: Sequence[_Task], monitor: Monitor) -> None:
    """Several sessions; those that a worker had finished before it died are whole."""
    for task in tasks:
        if not _is_done(task):
            _render(task, monitor)


def _render(task: _Task, monitor: Monitor) -> None:
    """One session."""
    sequence = SimulatedSequence(task.campaign, task.session)
    if task.images:
        _write_images(sequence, task.target, monitor)
        return

    def count(_: str) -> None:
        monitor.advance(sequence.drive.plan.words)

    truth_path(task.target).unlink(missing_ok=True)  # it says that the session is whole
    if _is_outdated(task.target):
        task.target.unlink()
    report = extract_log(sequence, task.target, task.settings, Advancing(count), MOST_LANDMARKS)
    if report.interrupted:
        raise KeyboardInterrupt
    plan = sequence.drive.plan
    comments = [f"{plan.name}: {plan.weather}, {plan.start:%Y-%m-%d %H:%M} UTC, {plan.robot}"]
    comments.append(f"rig: {sequence.drive.residual.text()}")
    rows = [Met.HEADER, *(met.row() for met in sequence.drive.met)]
    _write(met_path(task.target), ("\n".join(rows) + "\n").encode())
    write_tum(truth_path(task.target), sequence.truth(), comments)


def met_path(target: Path) -> Path:
    """What a drive met, next to its frame log."""
    return target.with_suffix(".met.csv")


def _write_images(sequence: SimulatedSequence, target: Path, monitor: Monitor) -> None:
    """KITTI odometry's layout; the poses come last and mark the sequence as whole."""
    camera = sequence.camera
    for name in ("image_0", "image_1"):
        _make_folder(target / name)
    _make_folder(_poses_path(target).parent)
    stamps = []
    for k, pair in enumerate(sequence):
        for name, image in (("image_0", pair.left), ("image_1", pair.right)):
            _write(target / name / f"{k:06d}.png", cv2.imencode(".png", image)[1].tobytes())
        stamps.append(pair.stamp_ns)
        monitor.advance(sequence.drive.plan.words)
    projection = np.array(
        [[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0]]
    )
    lines = []
    for number, baseline_m in enumerate((0.0, camera.baseline_m)):
        projection[0, 3] = -camera.fx * baseline_m
        lines.append(f"P{number}: " + " ".join(f"{value:.12e}" for value in projection.ravel()))
    _write(target / "calib.txt", "\n".join(lines).encode() + b"\n")
    seconds = "".join(f"{(stamp - stamps[0]) / 1e9:.9f}\n" for stamp in stamps)
    _write(target / "times.txt", seconds.encode())
    poses = sequence.drive.world_from_cams()
    first_from_world = poses[0].inverse()
    rows = "".join(_kitti_row(first_from_world @ pose) for pose in poses)
    _write(_poses_path(target), rows.encode())


def _kitti_row(first_from_cam: SE3) -> str:
    values = first_from_cam.matrix()[:3].ravel()
    return " ".join(f"{value:.9e}" for value in values) + "\n"


def _poses_path(target: Path) -> Path:
    return target.parent.parent / "poses" / f"{target.name}.txt"


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _cannot_write(folder, error) from error


def _write(path: Path, content: bytes) -> None:
    try:
        with write_whole(path) as draft:
            draft.write_bytes(content)
    except OSError as error:
        raise _cannot_write(path, error) from error


def _cannot_write(path: Path, error: OSError) -> SequenceError | StorageFullError:
    return storage_full(error, path) or SequenceError(
        f"{path}: cannot be written: {error.strerror}"
    )
