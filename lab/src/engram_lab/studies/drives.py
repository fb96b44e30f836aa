"""The drives that an evaluation runs on: a campaign's frame logs, or a user's own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from shlex import quote

from engram.config import config_hash
from engram.errors import ConfigError, SequenceError
from engram.frontend import DescriptorKind
from engram.geometry import SE3, StereoCamera
from engram.graph.model import Session
from engram.robot import Settings, session_of_drive
from engram.sequences import FrameLog, LoggedFrame
from engram.sequences.trajectories import Trajectory
from engram_lab.town import WORLD_VERSION, Campaign, Size, campaign_named
from engram_lab.town.simulating import campaign_folder
from engram_lab.town.upkeep import Upkeep, bring_up_to_date, known_frontends
from engram_lab.truth import read_truth, truth_path


@dataclass(frozen=True, slots=True)
class EvaluatedDrive:
    """One drive, recorded as a frame log.

    Attributes:
        path: NAME.framelog.
        session: its session.
        camera: its camera.
        descriptor: kind of its descriptors.
        frontend, odometry: hashes of the front-end and the odometry that made it.
        truth_hash: of its true poses, which stand beside it; None where there are none. Those of
            all drives of an evaluation are in one world frame.
        world: version of the simulated world that it was rendered in; None for other drives.
    """

    path: Path
    session: Session
    camera: StereoCamera
    descriptor: DescriptorKind
    frontend: str
    odometry: str
    truth_hash: str | None
    world: int | None = None

    @property
    def name(self) -> str:
        """For people; several drives may have the same."""
        return self.path.stem

    @property
    def key(self) -> str:
        """For files and tasks: no two drives of an evaluation have the same."""
        return f"{self.name}-{self.session.id.hex[-12:]}"

    @property
    def has_truth(self) -> bool:
        """Whether its true poses are known."""
        return self.truth_hash is not None

    def frames(self) -> list[LoggedFrame]:
        """All its frames, in memory."""
        log = FrameLog(self.path)
        try:
            return list(log)
        finally:
            log.close()

    def truth(self) -> Truth | None:
        """Its true poses; None where they are not known."""
        return None if self.truth_hash is None else _truth(self.path, self.truth_hash)


class Truth:
    """True poses of one drive's frames, by stamp."""

    def __init__(self, trajectory: Trajectory) -> None:
        self._poses = dict(
            zip(trajectory.stamps_ns.tolist(), trajectory.world_from_cam, strict=True)
        )

    def at(self, stamp_ns: int) -> SE3 | None:
        """``world_from_cam`` of the frame with this very stamp; None if it has none."""
        return self._poses.get(stamp_ns)


@lru_cache(maxsize=256)
def _truth(path: Path, content: str) -> Truth | None:
    del content  # another content is another truth to remember
    trajectory = read_truth(path)
    return None if trajectory is None else Truth(trajectory)


@dataclass(frozen=True, slots=True)
class DriveSet:
    """What is evaluated together.

    Attributes:
        name: of the campaign; for figures, tables and folders.
        drives: in the order of time.
    """

    name: str
    drives: tuple[EvaluatedDrive, ...]

    @staticmethod
    def of(drives: tuple[EvaluatedDrive, ...]) -> DriveSet:
        """Drives of one's own, named after the first and the last.

        Names that are mere numbers say nothing; their folder's does.
        """
        first, last = (drives[at].path for at in (0, -1))
        if first.stem.isdecimal():
            return DriveSet(first.resolve().parent.name or "logs", drives)
        return DriveSet(f"{first.stem}-to-{last.stem}", drives)

    @property
    def has_truth(self) -> bool:
        """Whether all drives have their truth next to them."""
        return all(drive.has_truth for drive in self.drives)

    @property
    def hash(self) -> str:
        """Changes with any drive, what made it, and its truth: what caches are kept by."""
        return config_hash(
            {
                str(one.session.id): (one.frontend, one.odometry, one.truth_hash)
                for one in self.drives
            }
        )


def open_campaign(
    text: str, campaigns: Path, size: Size = Size.STANDARD, settings: Settings | None = None
) -> DriveSet:
    """A rendered campaign, by ``NAME`` or ``NAME@SEED`` of its town.

    Args:
        text: such as ``begbroke`` or ``village@2``.
        campaigns: folder below which campaigns were rendered.
        size: of the campaign.
        settings: of front-end and odometry; sessions of the same front-end get this odometry.

    Raises:
        ConfigError: there is no such campaign.
        SequenceError: some of its sessions are not rendered.
    """
    name, _, seed = text.partition("@")
    try:
        number = int(seed or 1)
    except ValueError:
        raise ConfigError(f"campaign {text!r}: the seed after @ must be a whole number") from None
    campaign = campaign_named(name, number, size)
    paths = campaign_logs(campaign, campaigns)
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise SequenceError(
            f"campaign {text!r}: {len(missing)} of {len(paths)} sessions are not rendered (the "
            f"first is {missing[0]}); run: engram lab simulate {campaign.home} --seed "
            f"{campaign.seed} --size {size.value} --out {quote(str(campaigns))}"
        )
    settings = settings or Settings()
    drives, ours = drives_of(paths), known_frontends(settings)
    same = [one.path for one in drives if one.frontend in ours]
    if {bring_up_to_date(path, settings) for path in same} - {Upkeep.KEPT}:
        drives = drives_of(paths)
    return DriveSet(text, tuple(replace(one, world=WORLD_VERSION) for one in drives))


def campaign_logs(campaign: Campaign, campaigns: Path) -> list[Path]:
    """Where the frame logs of a campaign's sessions stand, rendered or not."""
    folder = campaign_folder(campaigns, campaign)
    return [folder / f"{plan.name}.framelog" for plan in campaign.sessions]


def drives_of(paths: Sequence[Path]) -> tuple[EvaluatedDrive, ...]:
    """Frame logs as drives, in the order of time.

    Raises:
        SequenceError: one is not a frame log, was not recorded to its end, is there twice, or its
            truth cannot be read.
        IncompatibleError: they have different kinds of descriptors.
    """
    drives = sorted((_drive(path) for path in paths), key=lambda d: (d.session.start_ns, d.name))
    by_id: dict[object, EvaluatedDrive] = {}
    for drive in drives:
        other = by_id.setdefault(drive.session.id, drive)
        if other is not drive:
            raise SequenceError(f"{drive.path} and {other.path} are the same drive; give it once")
    kinds = {drive.descriptor for drive in drives}
    if len(kinds) > 1:
        raise SequenceError(
            f"the logs have descriptors of several kinds ({', '.join(sorted(kinds))}), which "
            "cannot be matched; extract them with one front-end"
        )
    return tuple(drives)


def _drive(path: Path) -> EvaluatedDrive:
    if path.suffix != ".framelog":
        raise SequenceError(f"{path}: is not a frame log; make one with: engram record {path}")
    log = FrameLog(path)
    try:
        if not log.complete:
            raise SequenceError(f"{path}: was not recorded to its end; give the same command again")
        drive = EvaluatedDrive(
            path,
            session_of_drive(log),
            log.camera,
            log.header.descriptor,
            log.header.frontend,
            log.header.odometry,
            _hash_of(truth_path(path)),
        )
    finally:
        log.close()
    drive.truth()  # what is wrong with it is to be told now, not once a map is built
    return drive


def _hash_of(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SequenceError(f"{path}: cannot be read: {error.strerror or error}") from error
