"""Writes `format-2.engram`: run once, when the format came to be. Never run it again.

    python -m tests.maps.data.make_format_2 FILE

What format 1 could not hold: a tag, words of nodes, a drive that was taken back and came again.
"""

from __future__ import annotations

import socket
import sys

import numpy as np
from tests.maps.maps import begin, session, write_drive

from engram.maps import Map


def main(path: str) -> None:
    socket.gethostname = lambda: "example"
    with Map.create(path) as store:
        for name in ("robot-1", "robot-2"):
            writer = begin(store, session(name), message=name)
            drive = write_drive(writer, 3)
            writer.commit()
        store.tag("both", author="tests", message="two drives")
        store.revert("head", author="tests", message="loose camera")
        again = begin(store, session("robot-2"), message="again")
        write_drive(again, 4)
        again.commit()
        store.put_words(bytes(16), {drive.nodes[0].id: np.array([1, 5, 9], np.int32)})


if __name__ == "__main__":
    main(sys.argv[1])
