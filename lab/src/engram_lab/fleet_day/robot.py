"""One robot of the day: it drives, hands in, downloads, and drives again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import EngramError
from engram.fleet.agent.agent import MAP, Agent
from engram.fleet.agent.agent_state import AgentSettings
from engram.fleet.agent.centre_link import Unreachable
from engram.fleet.agent.outbox import QUEUED, SENT
from engram.fleet.centre.merge_job import merge_hand_in
from engram.fleet.centre.service import Centre
from engram.fleet.centre.worker import work_off
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Position
from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.monitor import Monitor
from engram.robot.mapping import Beginning, map_drive
from engram.sequences.opening import open_drive
from engram_lab.truth import read_truth

# Rounds in which a hand-in or a download is over. Each broken connection takes one, and what
# arrived by then stays: 200 kB a round make 40 MB.
_ROUNDS = 200
# Drives of the hamlet begin beside one another, in the yard where its robots are parked.
_YARD_M, _YARD_RAD = 1.0, 0.1


@dataclass(frozen=True, slots=True)
class Drive:
    """What one drive with one map came to.

    Attributes:
        held: nodes of the map before the drive.
        localised: share of the frames.
        added: nodes that the drive saved.
    """

    held: int
    localised: float
    added: int


@dataclass(frozen=True, slots=True)
class Foray:
    """One robot's second drive, with either map, and the day's traffic.

    Attributes:
        robot: its name.
        download: the selection by which the fleet's map was cut for it.
        alone: the drive with its own map.
        shared: the same drive with the download.
        fell_back: whether the robot went back to its own map afterwards.
        sent_bytes, received_bytes: bodies of all its requests and answers, what was sent again
            included.
    """

    robot: str
    download: str
    alone: Drive
    shared: Drive
    fell_back: bool
    sent_bytes: int
    received_bytes: int


class DayRobot:
    """A robot that has enrolled.

    Args:
        folder: of its agent.
        centre: whose work is done between the agent's rounds.
        monitor: hears of every frame and every round.
    """

    def __init__(self, folder: Path, centre: Centre, monitor: Monitor) -> None:
        self.name = folder.name
        self.live = folder / "live" / MAP
        self._folder = folder
        self._centre = centre
        self._monitor = monitor
        self._sent = self._received = 0

    def drive(self, log: Path, path: Path | None = None) -> Drive:
        """Drives with the live map, or with another one."""
        path = path or self.live
        held = _nodes(path)
        sequence = open_drive(log, robot=self.name)
        whose = f"{held} nodes" if held else "no map yet"
        with self._monitor.stage(f"{self.name} drives {log.stem}, {whose}", len(sequence)) as part:
            found = map_drive(path, sequence, monitor=part, begin=_place_at_yard)
        if found.interrupted:
            raise KeyboardInterrupt
        return Drive(held, found.to_dict()["share_localised"], found.saved)

    def hand_in(self, foray: str) -> None:
        """Sends what the live map holds, and waits until the centre has merged it.

        Raises:
            EngramError: the centre refuses it, or it takes too many rounds.
        """
        with self._agent({}) as agent:
            agent.hand_in()
            what = f"{self.name} hands in its {foray} foray"
            self._rounds(agent, what, lambda: _is_none_left(agent, QUEUED), fetch=False)
            what = f"the centre merges {self.name}'s {foray} foray"
            self._rounds(agent, what, lambda: _is_none_left(agent, SENT), fetch=False)

    def download(self, options: dict[str, Any]) -> None:
        """Fetches what the next mission needs, and switches to it.

        Raises:
            EngramError: the centre cannot make it, or it takes too many rounds.
        """
        with self._agent(options) as agent:
            what = f"{self.name} downloads, {options['select']}"
            self._rounds(agent, what, lambda: agent.status()["staged"] is not None)
            if not agent.switch():
                raise EngramError(f"{self.name} did not switch: {agent.status()}")

    def second_foray(self, log: Path, options: dict[str, Any]) -> Foray:
        """Drives with its own map alone, then with a download; hands in the second."""
        own = self._folder / "alone.engram"
        copy_map(self.live, own)
        alone = self.drive(log, own)
        self.download(options)
        shared = self.drive(log)
        with self._agent({}) as agent:
            fell_back = agent.drove(shared.localised, _length_m(log))
        self.hand_in("second")
        return Foray(
            self.name,
            options["select"],
            alone,
            shared,
            fell_back,
            self._sent,
            self._received,
        )

    @contextmanager
    def _agent(self, download: dict[str, Any]) -> Iterator[Agent]:
        with Agent(self._folder, AgentSettings(download=download)) as agent:
            yield agent
            self._sent += agent.link.sent_bytes
            self._received += agent.link.received_bytes

    def _rounds(
        self, agent: Agent, what: str, is_over: Callable[[], bool], *, fetch: bool = True
    ) -> None:
        """Lets agent and centre work in turn. A broken link is tried again, all else is an end.

        Raises:
            EngramError: the centre refuses or fails, or too many rounds passed.
        """
        breaks = 0
        with self._monitor.stage(what, _ROUNDS) as part:
            for _ in range(_ROUNDS):
                agent.step(fetch=fetch)
                failed = [entry.error for entry in agent.state.outbox() if entry.error]
                if failed:
                    raise EngramError(f"{what}: {failed[0]}")
                if agent.trouble is None and is_over():
                    return
                if not isinstance(agent.trouble, Unreachable | None):
                    raise EngramError(f"{what}: {agent.trouble}") from agent.trouble
                breaks += agent.trouble is not None
                work_off(self._centre, merge_hand_in)
                part.advance(f"the link broke {breaks} times")
        raise EngramError(
            f"{what}: not over after {_ROUNDS} rounds, in which the link broke {breaks} times; "
            f"the agent says {agent.status()}"
        )


def _is_none_left(agent: Agent, state: str) -> bool:
    return all(entry.state != state for entry in agent.state.outbox())


def _nodes(path: Path) -> int:
    if not path.exists():
        return 0
    with Map.open(path) as store:
        return store.node_count()


def _place_at_yard(foray: Beginning) -> None:
    """A foray begins as a drive that the map holds began, if it holds a start."""
    starts = (node.id for node in foray.opened.graph.nodes if node.driven_m < _YARD_M)
    first = next(starts, None)
    if first is not None and not foray.resumed:
        covariance = np.diag([_YARD_M**2] * 3 + [_YARD_RAD**2] * 3)
        foray.robot.place_at(Position(first, SE3.identity(), covariance))


def _length_m(log: Path) -> float:
    """How far the town's robot drove."""
    truth = read_truth(log)
    if truth is None:
        raise EngramError(f"{log}: the true path next to it is gone; remove the log as well")
    positions = np.array([pose.translation for pose in truth.world_from_cam])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
