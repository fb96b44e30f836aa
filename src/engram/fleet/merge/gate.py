"""Gates of a merge: held-out drives must not localise worse, and no wrong edge may appear."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import ConfigError, RefusedError
from engram.fleet.merge.report import HeldOutFigures, HeldOutReport
from engram.graph.model import EdgeKind, NodeId, Session, session_id
from engram.maps.map import Map
from engram.measures import Drive, Estimator, failure, longest_gap_m, route_not_localised
from engram.monitor import Monitor
from engram.repair.finding import Finding, RepairConfig, find_wrong_edges
from engram.robot.localisers import DriveSequence, session_of_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measure
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram.sequences.sequence import first_pair_hash

# Map A is no worse than B if P_A ≤ P_B up to 20 m and A's longest gap is at most 1.5 times B's.
_JUDGED_M = np.arange(0.0, 20.5, 0.5)
_LONGEST_GAP_RATIO = 1.5
# From a random point of the route: long gaps count by their length.
ESTIMATOR = Estimator.ROUTE
# Distances at which reports give the failure curve, metres (method §8).
_TOLD_M = (5, 10, 20)
# Rounding of sums of the same gaps in another order.
_ROUNDING = 1e-9


def check_held_out(
    drives: Iterable[tuple[Path | str, DriveSequence]],
    sessions: Iterable[Session],
    where: Path | str,
    option: str,
) -> None:
    """Refuses drives that a map holds: a drive localises well in a map of itself.

    A drive mapped under another robot's name has another session. It is recognised by camera,
    first stamp and the images of its first frame. The stamp alone does not suffice, since many
    data sets count from 0.

    Args:
        drives: the judging drives, each with its name for messages.
    """
    sessions = list(sessions)
    for name, sequence in drives:
        held = held_as(sequence, sessions)
        if held is not None:
            raise ConfigError(
                f"{name} is not held out: {where} contains this drive (session {held.id} of "
                f"{held.robot}); give {option} drives that are in none of the maps"
            )


def held_as(sequence: DriveSequence, sessions: Sequence[Session]) -> Session | None:
    """The session of this drive, whatever the robot's name; None if it is not in the map."""
    own = session_of_drive(sequence)
    for session in sessions:
        if session.id == own.id:
            return session
        named = session.as_recorded
        if (named.camera, named.start_ns) != (own.camera, own.start_ns):
            continue
        if session.id == session_id(
            named.robot, named.camera, named.start_ns, _first_pair(sequence)
        ):
            return session
    return None


def _first_pair(sequence: DriveSequence) -> str:
    """`first_pair_hash` of a drive that has a frame."""
    if isinstance(sequence, FrameLog):
        return sequence.first_pair_hash
    return first_pair_hash(next(iter(sequence)))


class Gate:
    """Compares the localisation of held-out drives in the fleet map before and after a merge.

    Args:
        drives: folders of images or frame logs, in none of the maps.
    """

    def __init__(
        self, drives: Sequence[Path], settings: Settings, options: RobotOptions | None = None
    ) -> None:
        self._paths = list(drives)
        self._sequences = [open_drive(path) for path in drives]
        self._settings = settings
        self._options = options or RobotOptions()
        self._before: list[Drive] | None = None

    def check_held_out(self, sessions: Iterable[Session], where: Path) -> None:
        """See the function of this name."""
        drives = zip(self._paths, self._sequences, strict=True)
        check_held_out(drives, sessions, where, "--require-better")

    def look_at(self, centre: Path, monitor: Monitor) -> None:
        """Measures the drives in the fleet map as it is, once before the first merge."""
        with Map.open(centre) as store:
            self._before = self._localise(store, monitor)

    def __call__(self, store: Map, robot: str, monitor: Monitor) -> HeldOutReport:
        """Measures the drives in the merged map.

        Args:
            monitor: its `check` is called between two frames.
        """
        assert self._before is not None
        before, after = self._before, self._localise(store, monitor)
        names = [path.name for path in self._paths]
        worse = what_is_worse(after, before)
        if worse:
            raise RefusedError(
                f"{robot} is refused: {', '.join(names)} localise worse in the result: {worse}; "
                "the fleet map is unchanged"
            )
        self._before = after
        return HeldOutReport(names, _figures(before), _figures(after))

    def _localise(self, store: Map, monitor: Monitor) -> list[Drive]:
        store.forget()  # during a merge the graph in memory is the merge's, not the file's
        return [
            measure(store, sequence, self._settings, self._options, monitor)
            for sequence in self._sequences
        ]


def what_is_worse(after: Sequence[Drive], before: Sequence[Drive]) -> str:
    """How one map is worse than another (failure curve of method §8, longest gap); "" if it is not.

    Args:
        after, before: the same drives in both maps.
    """
    facts = []
    curves = [_curve(drives) for drives in (after, before)]
    excess = curves[0] - curves[1]
    at = int(np.argmax(excess))
    if excess[at] > _ROUNDING:
        facts.append(
            f"P(no match within {_JUDGED_M[at]:.1f} m, {ESTIMATOR}) {curves[0][at]:.2%}, was "
            f"{curves[1][at]:.2%}"
        )
    longest = [longest_gap_m(drives) for drives in (after, before)]
    if longest[0] > _LONGEST_GAP_RATIO * longest[1] + _ROUNDING:
        facts.append(f"longest gap {longest[0]:.1f} m, was {longest[1]:.1f} m")
    if facts:
        shares = [route_not_localised(drives) for drives in (after, before)]
        facts.append(f"route not localised {shares[0]:.2%}, was {shares[1]:.2%}")
    return "; ".join(facts)


def _figures(drives: Sequence[Drive]) -> HeldOutFigures:
    return HeldOutFigures(
        route_not_localised(drives),
        longest_gap_m(drives),
        ESTIMATOR,
        {within_m: float(failure(drives, float(within_m))) for within_m in _TOLD_M},
    )


def _curve(drives: Sequence[Drive]) -> NDArray[np.float64]:
    return failure(drives, _JUDGED_M)


_Key: TypeAlias = tuple[NodeId, NodeId, EdgeKind]


class GeometryGate:
    """Finds the wrong edges of the fleet map after each merge.

    Args:
        refuses: whether a merge that brings new ones is refused.
    """

    def __init__(self, *, refuses: bool, config: RepairConfig | None = None) -> None:
        self._refuses = refuses
        self._config = config
        self._known: AbstractSet[_Key] = frozenset()

    def look_at(self, place: Path, monitor: Monitor) -> None:
        """Finds the wrong edges that the fleet map has before the first merge."""
        if self._refuses:
            with Map.open(place) as store:
                self._known = {_key(finding) for finding in self._wrong(store, monitor)}

    def __call__(self, store: Map, source: str, monitor: Monitor) -> list[dict[str, Any]]:
        """The wrong edges of the fleet map with an open merge, as plain values."""
        wrong = self._wrong(store, monitor)
        new = [finding for finding in wrong if _key(finding) not in self._known]
        if self._refuses and new:
            raise RefusedError(
                f"{source} would add {counted(len(new), 'wrong edge')}, the most certain of them: "
                f"{new[0].text()}; repair it with engram check {source} --geometry --repair"
            )
        self._known = {_key(finding) for finding in wrong}
        return [finding.to_dict() for finding in wrong]

    def _wrong(self, store: Map, monitor: Monitor) -> tuple[Finding, ...]:
        if not len(store.graph):
            return ()
        return find_wrong_edges(
            store.graph, store.path_memory, store.frames, self._config, monitor=monitor
        ).wrong


def _key(finding: Finding) -> _Key:
    return finding.edge.a, finding.edge.b, finding.edge.kind
