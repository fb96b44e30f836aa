"""Writes `format-3.engram`: run once, when the format came to be. Never run it again.

    python -m tests.maps.data.make_format_3 FILE

What format 2 could not hold: the hash of the landmarks of a node that was not taken.
"""

from __future__ import annotations

import socket
import sys
from uuid import UUID

import numpy as np
from tests.maps.maps import begin, session, write_drive

from engram.geometry import SE3
from engram.graph.model import NodeId, Omission
from engram.maps import Map

OMITTED = NodeId(UUID(int=3))


def main(path: str) -> None:
    socket.gethostname = lambda: "example"
    with Map.create(path) as store:
        first = begin(store, session("robot-1"), message="the first")
        drive = write_drive(first, 3)
        first.commit()
        about = {"author": "tests", "message": "one like it", "configuration": {}}
        with store.begin_revision(**about) as writer:
            ahead = SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
            writer.add_omission(Omission(OMITTED, drive.nodes[1].id, ahead, bytes(range(16))))
            writer.commit()


if __name__ == "__main__":
    main(sys.argv[1])
