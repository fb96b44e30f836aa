"""The memory of a drive: its path through the map, and its match attempts (method §3)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from engram.frontend import Frame
from engram.graph.model import NodeId, PathEntry, PathEntryKind, PathId
from engram.localiser import Hint, Keeper, Localisation, LocalisationStatus, Localiser
from engram.localiser.chain import MOST_ON_TRIAL
from engram.mapper.saver import Records, Saver
from engram.maps import StoredSession
from engram.odometry import Motion

# Uncertainty of a resumed robot's pose in the node it last matched: the match basin is wide.
_RESUMED_SIGMA_M = 3.0
_RESUMED_SIGMA_RAD = float(np.deg2rad(20.0))


@dataclass(slots=True)
class _Held:
    """What a frame adds, while the fixes that it rests on may be withdrawn.

    Attributes:
        stamp_ns: of the frame.
        records: without path entries.
        visit: the node that it adds to the path, and how; None if none.
    """

    stamp_ns: int
    records: Records
    visit: tuple[NodeId, PathEntryKind] | None


class Walk:
    """Collects the entries of one session's path: one for each change of node (method §3.3)."""

    def __init__(self, path: PathId, first_sequence: int = 0, node: NodeId | None = None) -> None:
        self.path = path
        self._sequence = first_sequence
        self._node = node
        self._new: list[PathEntry] = []

    def visit(self, node: NodeId, kind: PathEntryKind, stamp_ns: int) -> None:
        """Adds an entry if the node differs from the last one."""
        if node == self._node:
            return
        self._new.append(PathEntry(self.path, self._sequence, node, kind, stamp_ns))
        self._node = node
        self._sequence += 1

    def take_new(self) -> list[PathEntry]:
        """The entries added since the last call."""
        taken, self._new = self._new, []
        return taken


class Memory(Keeper):
    """Remembers a drive without saving a node: its path and its attempts.

    The policies `path` and `recall` use them in later drives. What fixes on trial add is held back:
    those that are withdrawn leave no trace. Frames that an interrupted run had
    remembered are only followed; the memory continues after them.

    Args:
        localiser: the drive's localiser.
        saver: writes path and attempts.
        path: the drive's path.
        stored: what an interrupted run had stored of the drive; None for a new one.
    """

    def __init__(
        self, localiser: Localiser, saver: Saver, path: PathId, stored: StoredSession | None = None
    ) -> None:
        self._localiser = localiser
        self._saver = saver
        self._stored = stored
        self._held: deque[_Held] = deque()
        self.walk = Walk(path)
        if stored is not None and stored.last_entry is not None:
            self.walk = Walk(path, stored.next_sequence, stored.last_entry.node)
            localiser.resume(0.0, stored.next_iteration)

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `Keeper`: frames of an interrupted run are not localised again."""
        if not self._is_stored(live.stamp_ns):
            return None
        assert self._stored is not None
        entry, position = self._stored.last_entry, None
        if entry and entry.stamp_ns == live.stamp_ns and entry.kind is PathEntryKind.MATCHED:
            spread = np.diag([_RESUMED_SIGMA_M**2] * 3 + [_RESUMED_SIGMA_RAD**2] * 3)
            position = self._localiser.standing_at(entry.node, live, spread)
        followed = Localisation(
            live.stamp_ns, LocalisationStatus.DEAD_RECKONING, 0, 0, 0.0, motion, resumed=True
        )
        return Hint(position, guessed_m=np.inf, found=followed)

    def keep(self, live: Frame, found: Localisation) -> Localisation:
        """See `Keeper`."""
        if not found.resumed:
            self._put(live, Records(), match_of(found))
        return found

    def withdrawn(self, found: Localisation) -> None:
        """See `Keeper`: the frame was not localised, and its attempts failed."""
        for one in self._held:
            if one.stamp_ns == found.stamp_ns:
                failed = [replace(attempt, accepted=False) for attempt in one.records.attempts]
                one.records, one.visit = replace(one.records, attempts=failed), None

    def finish(self) -> None:
        """See `Keeper`: what is still held back is kept."""
        self._release()

    def _is_stored(self, stamp_ns: int) -> bool:
        """Whether an interrupted run processed the frame."""
        last_ns = None if self._stored is None else self._stored.last_stamp_ns
        return last_ns is not None and stamp_ns <= last_ns

    def _put(
        self, live: Frame, records: Records, visit: tuple[NodeId, PathEntryKind] | None
    ) -> None:
        """Adds the frame's attempts and its visit, and hands all to the saver once it is sure."""
        records = replace(records, attempts=self._localiser.attempts())
        self._held.append(_Held(live.stamp_ns, records, visit))
        waiting = MOST_ON_TRIAL if self._localiser.on_trial else 0
        if waiting:
            self._saver.hold(records)
        self._release(waiting)

    def _release(self, waiting: int = 0) -> None:
        """Hands frames to the saver, but for so many of the newest."""
        while len(self._held) > waiting:
            one = self._held.popleft()
            if one.visit is not None:
                self.walk.visit(*one.visit, one.stamp_ns)
            records = replace(one.records, path_entries=self.walk.take_new())
            if records:
                self._saver.put(records)


def match_of(found: Localisation) -> tuple[NodeId, PathEntryKind] | None:
    """The visit of a localised frame; None for another."""
    return None if found.node is None else (found.node, PathEntryKind.MATCHED)
