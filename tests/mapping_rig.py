"""Maps simulated drives into a real map file, and localises others in it."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.synthetic_world import Seen

from engram.geometry.se3 import SE3
from engram.graph.model import Clock, NodeId, Session, path_id, session_id
from engram.localiser.localisation import Budget, Localisation
from engram.localiser.localiser import Localiser
from engram.mapper.mapper import Mapper, Saver
from engram.maps.map import Map, open_map
from engram.robot.drive_session import RevisionSink, loop_search
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings


@dataclass
class Mapped:
    """What mapping a drive came to, beside the truth."""

    steps: list[Localisation]
    drive: list[Seen]

    @property
    def statuses(self) -> list[str]:
        return [step.status.value for step in self.steps]

    @property
    def saved(self) -> dict[NodeId, SE3]:
        """Truth of each node that was saved."""
        return {
            step.saved: seen.world_from_live
            for step, seen in zip(self.steps, self.drive, strict=True)
            if step.saved is not None
        }


def session_for(drive: list[Seen], name: str, longitude_deg: float | None = None) -> Session:
    """The session of a drive; its stamps are of UTC where a longitude is given."""
    first = drive[0].frame
    return Session(
        session_id(name, first.camera.id, first.stamp_ns, name),
        name,
        first.camera.id,
        first.stamp_ns,
        Clock.RELATIVE if longitude_deg is None else Clock.UTC,
        longitude_deg,
    )


def map_simulated(
    path: Path,
    drive: list[Seen],
    name: str = "r1",
    policy: str = "path",
    *,
    closes_loops: bool = False,
    longitude_deg: float | None = None,
    settings: Settings | None = None,
    **budget: int,
) -> Mapped:
    first, settings = drive[0].frame, settings or Settings()
    with open_map(path, create=True) as opened, opened.writing():
        session = session_for(drive, name, longitude_deg)
        writer = opened.begin_session(
            session,
            first.camera,
            descriptor=first.descriptor,
            frontend=first.frontend,
            author=name,
            configuration={},
        )
        sink = RevisionSink(writer, opened.frames, None, settings.placing)
        saver = Saver(sink, path_id(session.id))
        localiser = localiser_in(
            opened,
            first.camera,
            settings,
            policy=policy,
            budget=Budget(**budget),
            live=session.id,
            saves=True,
        )
        loops = loop_search(opened, localiser, settings) if closes_loops else None
        with localiser, loops or nullcontext():
            mapper = Mapper(opened.graph, localiser, saver, session, settings.mapper, loops)
            robot = Robot(Front(settings), localiser, mapper)
            steps = [robot.step(seen.logged) for seen in drive]
            mapper.finish()
        saver.finish()
        writer.commit(settings.placing)
    return Mapped(steps, drive)


def localised(localiser: Localiser, drive: Iterable[Seen]) -> list[Localisation]:
    """What a localiser finds of frames, one after another."""
    robot = Robot(Front(Settings()), localiser)
    return [robot.step(seen.logged) for seen in drive]


def localise_simulated(
    path: Path,
    drive: list[Seen],
    policy: str = "path",
    relocaliser: str | None = "exhaustive",
    budget: Budget | None = None,
) -> list[Localisation]:
    with Map.open(path) as opened:
        localiser = localiser_in(
            opened,
            drive[0].frame.camera,
            Settings(),
            policy=policy,
            budget=budget,
            relocaliser=relocaliser,
        )
        with localiser:
            return localised(localiser, drive)


def errors_m(found: list[Localisation], drive: list[Seen], nodes: dict[NodeId, SE3]) -> np.ndarray:
    """Distance between measured and true position of each localised frame."""
    return np.array(
        [
            np.linalg.norm(
                (nodes[one.node].inverse() @ seen.world_from_live).translation
                - one.node_from_live.translation
            )
            for one, seen in zip(found, drive, strict=True)
            if one.node is not None
        ]
    )
