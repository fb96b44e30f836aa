"""Robots in a map: on a recorded drive, or live."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from engram.errors import ConfigError, InputError, MapError, MapLockedError, RevisionError
from engram.geometry import StereoCamera
from engram.maps import Map, open_map
from engram.ranking import RankingPolicy
from engram.robot.fixed import ToldFix, relocaliser_with_fixes, suggesting
from engram.robot.front import Front
from engram.robot.live import Into, IntoMap, IntoMemory, LiveDrive, Owner
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.saved import Saving, SavingState
from engram.robot.saving import commit_crashed
from engram.robot.session import DriveSequence, session_of_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.spool import commit_spools
from engram.sequences import check_name


def robot_on(
    opened: Map,
    sequence: DriveSequence,
    settings: Settings,
    options: RobotOptions | None = None,
    policy: RankingPolicy | None = None,
    *,
    remembers: bool = False,
) -> Robot:
    """A robot that localises a drive in a map, and saves no nodes.

    Args:
        opened: the map.
        sequence: the drive, for `Robot.drive`.
        settings: the resolved configuration.
        options: ranking policy and budget; None for the defaults.
        policy: replaces that of the options.
        remembers: whether path and attempts are kept as a session; see `Map.robot`.

    Raises:
        ConfigError: the policy or the relocaliser is unknown, or the threads are too few.
        SequenceError: the drive has no usable frame.
    """
    options, settings = options or RobotOptions(), settings.for_descriptor(opened.descriptor)
    session = session_of_drive(sequence)
    finder = relocaliser_with_fixes(opened, sequence, settings, options.relocaliser)
    if remembers:
        _check_newest(opened)
        owner = Owner(session.robot, sequence.camera, settings, options, session, finder)
        return _keeping(owner, IntoMemory(owner, opened))
    localiser = localiser_in(
        opened,
        sequence.camera,
        settings,
        policy=policy or options.ranking,
        budget=options.budget,
        relocaliser=finder,
        live=session.id,
        threads=options.lane_threads(),
        clock=sequence.info,
    )
    front = Front(settings, sequence.camera)
    return Robot(front, localiser, deadline_ms=options.deadline_ms)


def robot_in(
    opened: Map,
    owner: Owner,
    *,
    maps: bool = False,
    remembers: bool = False,
    front: Front | None = None,
    fix: ToldFix | None = None,
) -> Robot:
    """A live robot; see `Map.robot`.

    A `front` continues the odometry of the robot before it; a `fix` of satellites proposes nodes.
    """
    if not isinstance(owner.camera, StereoCamera):
        raise InputError(f"camera is {owner.camera!r}, must be an engram.StereoCamera")
    if owner.name is not None:
        check_name(owner.name)
    owner = replace(owner, settings=owner.settings.for_descriptor(opened.descriptor))
    saving = None
    if maps or remembers:
        saving = _saving_in(opened, owner, maps=maps)
        if saving.recovered:  # their drives may be played again
            owner = replace(owner, known=frozenset(opened.sessions))
    if fix is not None:
        finder = suggesting(opened, fix, owner.settings, owner.options.relocaliser)
        owner = replace(owner, finder=finder)
    if not (maps or remembers):
        localiser, deadline_ms = owner.localiser_in(opened), owner.options.deadline_ms
        front = front or Front(owner.settings, owner.camera)
        return Robot(front, localiser, deadline_ms=deadline_ms)
    if not maps or saving is None:
        return _keeping(owner, IntoMemory(owner, opened), front, saving)
    try:
        commit_spools(Path(opened.location))
        into: Into = IntoMap(owner, open_map(opened.location))
    except MapLockedError:
        raise
    except MapError as error:  # on a read-only disk it localises, as on a full one
        saving.state, saving.reason = SavingState.FAILED, str(error)
        into = IntoMemory(owner, opened)
    return _keeping(owner, into, front, saving)


def _saving_in(opened: Map, owner: Owner, *, maps: bool) -> Saving:
    """The saving of a drive that begins; first seals what a killed robot of the name had mapped.

    Where that cannot be written, the robot localises and saves nothing.

    Raises:
        ConfigError: the robot has no name.
        RevisionError: the map was opened at a named revision.
        MapLockedError: another process writes to the map.
    """
    if owner.name is None:
        raise ConfigError("a robot that keeps its drives needs a name: give name=")
    _check_newest(opened)
    saving = Saving(SavingState.ON)
    try:
        saving.recovered = commit_crashed(opened, owner.name, owner.settings) if maps else ()
    except MapLockedError:
        raise
    except MapError as error:
        saving.state, saving.reason = SavingState.FAILED, str(error)
    return saving


def _check_newest(opened: Map) -> None:
    """Refuses to keep drives in a map opened at an older revision.

    Raises:
        RevisionError: the map was opened at a named revision.
    """
    if opened.is_pinned:
        raise RevisionError(
            f"{opened.location} is open at revision {opened.revision}; to keep drives, open it "
            "without naming a revision"
        )


def _keeping(
    owner: Owner, into: Into, front: Front | None = None, saving: Saving | None = None
) -> Robot:
    live, deadline_ms = LiveDrive(owner, into, saving), owner.options.deadline_ms
    front = front or Front(owner.settings, owner.camera)
    return Robot(front, into.localiser, live=live, deadline_ms=deadline_ms)
