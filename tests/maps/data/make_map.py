"""Writes `format-7.engram`. Run it only while format 7 is the newest.

    python -m tests.maps.data.make_map FILE

One map with a row of every kind: two drives, the second reverted and mapped again, one that was
interrupted, one that was forgotten and erased, a superseded edge, an omission, an amendment, marks,
words, places and tags.
"""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from uuid import UUID

import numpy as np
from tests.maps.maps import begin, edge, session, write_drive

from engram.geometry.se3 import SE3
from engram.graph.model import (
    Amendable,
    Anchor,
    EdgeKind,
    Goal,
    NodeId,
    Omission,
    Placement,
    Removal,
)
from engram.maps.forgetting import Chosen, erase_map
from engram.maps.map import Map
from engram.maps.place_blocks import BODY, NUMBERS, UNREADABLE

OMITTED = NodeId(UUID(int=3))
AUTHOR = "tests"


def write_map(path: Path | str) -> None:
    """The map; the same rows each time, but for the clock."""
    with Map.create(path) as store:
        first = begin(store, session("robot-1"), message="the first")
        drive = write_drive(first, 4)
        ends = (drive.nodes[0].id, drive.nodes[3].id)
        first.add_edge(edge(*ends, EdgeKind.PROXIMITY, seed=1))
        first.put_statistic("basin", {"g": [0.94, 0.7, 0.4]})
        first.commit()
        second = begin(store, session("robot-2"), message="the second")
        other = write_drive(second, 3)
        second.add_edge(edge(*ends, EdgeKind.PROXIMITY, seed=2))
        second.commit()
        store.tag("both", author=AUTHOR, message="two drives")
        store.tag("wrong", author=AUTHOR)
        store.untag("wrong", author=AUTHOR)
        store.revert("head", author=AUTHOR, message="loose camera")
        again = begin(store, session("robot-2"), message="again")
        write_drive(again, 5)
        again.commit()
        store.put_words(bytes(16), {other.nodes[0].id: np.array([1, 5, 9], np.int32)})
        block = {NUMBERS: b"", UNREADABLE: np.array([3, 8191], "<i4").tobytes(), BODY: bytes(9)}
        store.put_place_block(bytes(16), "signature", 0, block)
        zone = {Amendable.ROBOT: "robot-9", Amendable.ZONE: "Europe/London"}
        store.amend(session("robot-2").id, zone, author=AUTHOR)
        with store.begin_revision(author=AUTHOR, message="marks", configuration={}) as writer:
            ahead = SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
            writer.add_omission(Omission(OMITTED, drive.nodes[1].id, ahead, bytes(range(16))))
            step = drive.edges[0]
            writer.add_mark(Removal(step.a, step.b, step.kind, step.a_from_b, "a test", 5))
            for node in drive.nodes:
                writer.add_mark(Placement(node.id, SE3.identity()))
            writer.add_mark(Anchor(drive.nodes[0].id, 1.0, 2.0, None, 0.5, "a test"))
            writer.add_mark(Goal("dock", drive.nodes[1].id, SE3.identity()))
            writer.commit()
        fifth = begin(store, session("robot-5"))
        write_drive(fifth, 2)
        fifth.commit()
        forgotten = Chosen(sessions=frozenset([fifth.session.id]))
        store.forget_nodes(forgotten, author=AUTHOR, message="forget: a test", configuration={})
    erase_map(Path(path))
    with Map.open(path, writes=True) as store:
        third = begin(store, session("robot-3"))
        write_drive(third, 2)
        third.checkpoint()


if __name__ == "__main__":
    socket.gethostname = lambda: "example"
    write_map(sys.argv[1])
