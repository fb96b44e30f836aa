"""Writes sessions into a map and says what it has done, until somebody kills it."""

from __future__ import annotations

import sys

from tests.maps.maps import Drive, begin, session

from engram.maps.map import Map


def say(*words: object) -> None:
    # In one piece, so that a kill cannot leave half a line, whatever the stream buffers.
    print(" ".join(map(str, words)) + "\n", end="", flush=True)


def main(path: str, sessions: int, nodes: int) -> None:
    with Map.open(path, writes=True) as store:
        for number in range(sessions):
            drive = session(f"robot-{number}")
            state = store.session_state(drive.id)
            if state == "committed":
                continue
            if state == "interrupted":
                writer = store.resume_session(drive.id)
            else:
                writer = begin(store, drive)
            written = Drive(drive, list(writer.stored.nodes))
            say("begun", number, len(written.nodes))
            for index in range(len(written.nodes), nodes):
                written.write_node(writer, index)
                if index % 3 == 2:
                    say("checkpointing", number, index + 1)
                    writer.checkpoint()
                    say("checkpointed", number, index + 1)
            say("committing", number, nodes)
            writer.commit()
            say("committed", number, nodes)
        say("done", sessions, nodes)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
