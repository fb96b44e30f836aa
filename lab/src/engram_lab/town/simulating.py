"""Rendering a campaign to disk: frame logs with truth, or images in KITTI's layout."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import Empty
from typing import Any

import cv2
import numpy as np

from engram.config import config_hash
from engram.errors import (
    ConfigError,
    IncompatibleError,
    SequenceError,
    StorageFullError,
    WorkerError,
    storage_full,
)
from engram.frontend import Frontend
from engram.geometry import SE3
from engram.monitor import ignore
from engram.processes import end_with_parent
from engram.robot.recording import extract_log
from engram.robot.settings import Settings
from engram.sequences import FrameLog
from engram.sequences.trajectories import truth_path, write_tum
from engram_lab.town import WORLD_VERSION, Campaign
from engram_lab.town.sequence import SimulatedSequence

_PENDING_S = 0.2  # between looks at the queue of the workers


@dataclass(slots=True)
class SimulateReport:
    """What rendering a campaign came to.

    Attributes:
        folder: where the sessions are.
        rendered, already_there: sessions of this run, and of earlier ones.
        frames: stereo pairs rendered by this run.
        files: one frame log, or one KITTI sequence folder, a session, in the order of time.
    """

    folder: str
    rendered: int = 0
    already_there: int = 0
    frames: int = 0
    files: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """What ``simulate --json`` prints."""
        return asdict(self)

    def text(self) -> str:
        """For people."""
        return (
            f"{self.rendered} sessions rendered ({self.frames} pairs), {self.already_there} were "
            f"there already, in {self.folder}"
        )


@dataclass(frozen=True, slots=True)
class _Task:
    campaign: Campaign
    session: int
    target: Path
    images: bool
    settings: Settings


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
    advance: Callable[[str], None] = ignore,
) -> SimulateReport:
    """Renders a campaign's sessions that are not there yet.

    Frame logs stand as `NAME.framelog` with `NAME.truth.txt` beside them; images in KITTI's
    odometry layout, `sequences/NN` and `poses/NN.txt`. A killed run is resumed by the same call:
    whole sessions are kept, a session that was begun is rendered again.

    Args:
        campaign: what to render.
        out: folder; the campaign gets its own below it (`campaign_folder`).
        images: KITTI layout instead of frame logs.
        sessions: numbers of the sessions wanted, each once however often it is named; None for
            all.
        workers: processes; each renders one session at a time and holds about 0.7 GB.
        settings: of front-end and odometry; None for the defaults.
        advance: called with a session's name, once per pair that is rendered or was there already.

    Raises:
        ConfigError: no such session, or fewer than one worker.
        IncompatibleError: a session that is there was made by another front-end or odometry.
        StorageFullError: no space is left; what was finished is kept.
        SequenceError: a file cannot be written.
        WorkerError: a worker died, perhaps for want of memory; finished sessions are kept.
    """
    if workers < 1:
        raise ConfigError(f"workers is {workers}, must be >= 1")
    folder = campaign_folder(out, campaign)
    report = SimulateReport(str(folder))
    tasks = []
    every = range(len(campaign.sessions))
    for number in every if sessions is None else sorted(set(sessions)):
        task = _task(campaign, number, folder, images, settings or Settings())
        report.files.append(str(task.target))
        if _is_done(task):
            report.already_there += 1
            for _ in range(len(SimulatedSequence(campaign, number))):
                advance(campaign.session(number).name)
        else:
            tasks.append(task)
    _make_folder(folder)
    run = _run_here if workers == 1 or len(tasks) < 2 else _run_in_workers
    report.frames = run(tasks, workers, advance)
    report.rendered = len(tasks)
    return report


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
    try:
        if log.complete:
            _check_made_by(task, log)
        return log.complete
    finally:
        log.close()


def _check_made_by(task: _Task, log: FrameLog) -> None:
    """Refuses logs of other settings: a campaign is of one make, or its sessions do not compare."""
    for what, made, wanted in (
        ("front-end", log.header.frontend, Frontend(task.settings.frontend).hash),
        ("odometry", log.header.odometry, config_hash(task.settings.odometry)),
    ):
        if made != wanted:
            raise IncompatibleError(
                f"{task.target}: was rendered with another version or other settings of the {what} "
                f"({made}, now {wanted}); give another --out, or remove the folder to render anew"
            )


def _run_here(tasks: list[_Task], workers: int, advance: Callable[[str], None]) -> int:
    del workers
    return sum(_render(task, advance) for task in tasks)


def _run_in_workers(tasks: list[_Task], workers: int, advance: Callable[[str], None]) -> int:
    # Started afresh: a forked child would share the parent's threads half way through.
    context = multiprocessing.get_context("spawn")
    words: multiprocessing.Queue[str] = context.Queue()
    with ProcessPoolExecutor(workers, context, _remember_queue, (words,)) as pool:
        frames = 0
        try:
            pending: set[Future[int]] = {pool.submit(_render_in_worker, task) for task in tasks}
            while pending:
                done, pending = wait(pending, _PENDING_S, FIRST_COMPLETED)
                _pass_on(words, advance)
                frames += sum(future.result() for future in done)
        except BrokenProcessPool as error:
            raise WorkerError(
                f"a worker of {workers} died (out of memory?); give the same command again, "
                "perhaps with fewer --workers; finished sessions are kept"
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    _pass_on(words, advance)
    return frames


_words: multiprocessing.Queue[str] | None = None


def _remember_queue(words: multiprocessing.Queue[str]) -> None:
    global _words  # noqa: PLW0603, the one way to hand a queue to a pool's workers
    _words = words
    end_with_parent()


def _render_in_worker(task: _Task) -> int:
    assert _words is not None
    cv2.setNumThreads(1)  # the sessions run side by side
    return _render(task, _words.put)


def _pass_on(words: multiprocessing.Queue[str], advance: Callable[[str], None]) -> None:
    while True:
        try:
            advance(words.get_nowait())
        except Empty:
            return


def _render(task: _Task, advance: Callable[[str], None]) -> int:
    """One session; returns its number of pairs."""
    sequence = SimulatedSequence(task.campaign, task.session)
    if task.images:
        _write_images(sequence, task.target, advance)
        return len(sequence)

    def count(_: str) -> None:
        advance(sequence.info.name)

    report = extract_log(sequence, task.target, task.settings, count)
    if report.interrupted:
        raise KeyboardInterrupt
    plan = sequence.drive.plan
    comments = [f"{plan.name}: {plan.weather}, {plan.start:%Y-%m-%d %H:%M} UTC, {plan.robot}"]
    write_tum(truth_path(task.target), sequence.truth(), comments)
    return len(sequence)


def _write_images(
    sequence: SimulatedSequence, target: Path, advance: Callable[[str], None]
) -> None:
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
        advance(sequence.info.name)
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
    """In one step: a killed run leaves no half file under the name."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise _cannot_write(path, error) from error


def _cannot_write(path: Path, error: OSError) -> SequenceError | StorageFullError:
    return storage_full(error, path) or SequenceError(
        f"{path}: cannot be written: {error.strerror}"
    )
