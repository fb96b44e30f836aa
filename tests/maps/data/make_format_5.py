"""Writes `format-5.engram`: run once, when the format came to be. Never run it again.

    python -m tests.maps.data.make_format_5 FILE

What format 4 could not hold: removed edges, placed nodes, anchors and goals.
"""

from __future__ import annotations

import socket
import sys

from tests.maps.maps import begin, session, write_drive

from engram.geometry import SE3
from engram.graph.marks import Anchor, Goal, Placement, Removal
from engram.maps import Map


def main(path: str) -> None:
    socket.gethostname = lambda: "example"
    with Map.create(path) as store:
        first = begin(store, session("robot-1"), message="the first")
        write_drive(first, 3)
        first.commit()
        edge, nodes = store.load().edges[0], store.load().nodes
        with store.begin_revision(author="tests", message="marks", configuration={}) as writer:
            writer.add_mark(Removal(edge.a, edge.b, edge.kind, edge.a_from_b, "a test", 5))
            for node in nodes:
                writer.add_mark(Placement(node.id, SE3.identity()))
            writer.add_mark(Anchor(nodes[0].id, 1.0, 2.0, None, 0.5, "a test"))
            writer.add_mark(Goal("dock", nodes[1].id, SE3.identity()))
            writer.commit()


if __name__ == "__main__":
    main(sys.argv[1])
