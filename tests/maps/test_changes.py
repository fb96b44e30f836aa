"""What changes between two revisions, and what is counted on from it, is what a reading finds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from engram.errors import RevisionError
from engram.graph.model import EdgeKind, NodeId, Removal
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.records import MapContents, SessionState

from .maps import begin, edge, session, write_drive
from .test_totals import compare

ROBOTS = ("robot-1", "robot-2", "robot-3")
Step = tuple[str, int, int]


class Story:
    """A map and what happens to it, as far as it is possible at that time."""

    def __init__(self, store: Map) -> None:
        self.store = store
        self.seed = 0

    def tell(self, step: Step) -> None:
        """One revision."""
        done: Callable[[int, int], None] = getattr(self, step[0])
        done(*step[1:])

    def drive(self, robot: int, count: int) -> None:
        """A drive, mapped again where a revert had hidden it, with a tie to another one."""
        driven = session(ROBOTS[robot % len(ROBOTS)])
        if self.store.session_state(driven.id) is SessionState.ABSENT:
            known = self.seen()
            writer = begin(self.store, driven)
            mapped = write_drive(writer, 1 + count % 4)
            if known and count % 3:
                writer.add_edge(self._edge(known[count % len(known)], mapped.nodes[0].id))
            writer.commit()

    def measure(self, at: int, other: int) -> None:
        """An edge between any two nodes, perhaps one more between the same."""
        known = self.seen()
        ends = [known[one % len(known)] for one in (at, other) if known]
        if len({*ends}) == 2:
            self._commit(lambda writer: writer.add_edge(self._edge(*ends)))

    def remove(self, which: int, _: int) -> None:
        """An edge that counts no longer."""
        if found := self.store.load().edges:
            one = found[which % len(found)]
            gone = Removal(one.a, one.b, one.kind, one.a_from_b, "a test", 5)
            self._commit(lambda writer: writer.add_mark(gone))

    def revert(self, which: int, _: int) -> None:
        """Any revision, a revert, too."""
        try:
            self.store.revert(1 + which % max(self.store.revision, 1), author="t")
        except RevisionError:
            return

    def seen(self) -> list[NodeId]:
        return [one.id for one in self.store.load().nodes]

    def _edge(self, a: NodeId, b: NodeId) -> Any:
        self.seed += 1
        kind = EdgeKind.MATCH if self.seed % 2 else EdgeKind.PROXIMITY
        return edge(a, b, kind, self.seed)

    def _commit(self, write: Callable[[Any], None]) -> None:
        with self.store.begin_revision(author="t", message="", configuration={}) as writer:
            write(writer)
            writer.commit()


def oracle(old: MapContents, new: MapContents) -> dict[str, Any]:
    """What differs, from all records of both."""
    nodes, entries, joined = (
        tuple({key(one): one for one in getattr(side, name)} for side in (old, new))
        for name, key in (
            ("nodes", lambda one: one.id),
            ("path_entries", lambda one: (one.path, one.sequence)),
            ("edges", lambda one: (one.a, one.b, one.kind)),
        )
    )
    by_kind = {}
    for kind in EdgeKind:
        was, now = ({key: e for key, e in side.items() if e.kind is kind} for side in joined)
        if was or now:
            again = sum(not _same(was[key], now[key]) for key in was.keys() & now.keys())
            by_kind[str(kind)] = {**_counts(was, now), "changed": again}
    drives = [{str(one.id) for one in side.sessions} for side in (old, new)]
    return {
        "nodes": _counts(*nodes),
        "path_entries": _counts(*entries),
        "edges": by_kind,
        "sessions": {"added": drives[1] - drives[0], "removed": drives[0] - drives[1]},
    }


def _same(one: Any, other: Any) -> bool:
    pairs = ((one.a_from_b.matrix(), other.a_from_b.matrix()), (one.covariance, other.covariance))
    return all(np.array_equal(*pair) for pair in pairs)


def _counts(was: dict[Any, Any], now: dict[Any, Any]) -> dict[str, int]:
    added, removed = now.keys() - was.keys(), was.keys() - now.keys()
    return {"before": len(was), "after": len(now), "added": len(added), "removed": len(removed)}


def check_difference(location: Path, before: int, after: int) -> None:
    with Map.open(location, at=before) as one, Map.open(location, at=after) as other:
        old, new, found = one.load(), other.load(), other.diff(before, after)
        components = [len(np.unique(store.graph.components())) for store in (one, other)]
    told = found.to_dict()
    wanted = oracle(old, new)
    for side in ("added", "removed"):
        given_ = {entry["session"] for entry in told["sessions"][side]}
        assert given_ == wanted["sessions"][side]
        assert sum(region[side] for region in told["regions"]) == wanted["nodes"][side]
        assert sum(told["hours"][side].values()) == wanted["nodes"][side]
    assert {name: told[name] for name in ("nodes", "path_entries", "edges")} == {
        name: wanted[name] for name in ("nodes", "path_entries", "edges")
    }
    assert list(told["components"].values()) == components
    assert found.added == {n.id for n in new.nodes} - {n.id for n in old.nodes}
    assert found.text().startswith(f"revision {before} → {after}")


STEP = st.tuples(
    st.sampled_from(["drive", "drive", "measure", "remove", "revert", "revert"]),
    st.integers(0, 40),
    st.integers(0, 40),
)


# An edge is measured again between nodes of which another edge was removed.
@example(
    steps=[("drive", 0, 1), ("remove", 0, 0), ("measure", 1, 0), ("drive", 1, 2)]
    + [("measure", 1, 0)] * 2,
    pair=(0, 0),
)
# A revert is taken back whose session a later one has hidden.
@example(
    steps=[
        ("drive", 31, 29),
        ("revert", 0, 0),
        ("drive", 16, 0),
        *[("revert", at, 0) for at in (0, 29)],
    ],
    pair=(0, 4),
)
@given(steps=st.lists(STEP, min_size=3, max_size=8), pair=st.tuples(*[st.integers(0, 20)] * 2))
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
def test_any_history_is_counted_on_and_compared(steps: list[Step], pair: tuple[int, int]) -> None:
    with TemporaryDirectory() as folder:
        location = Path(folder) / "town.engram"
        with Map.create(location) as store:
            story = Story(store)
            for step in steps:
                story.tell(step)
                compare(location)
            last = store.revision
        assert check_file(location).problems == ()
        check_difference(location, last, max(last - 1, 0))
        check_difference(location, *(one % (last + 1) for one in pair))
