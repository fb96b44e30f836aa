"""kill -9 while a drive is being mapped: does the map open, whole, and how much is lost?

A drive there and back is mapped by a process of its own, which is killed at a random moment; some
kills are aimed into a commit of the database. Then the map is opened and checked, and its
interrupted session is resumed or sealed in turn.

    python -m engram_lab.checks.kill_mapping $ENGRAM_DATA/kitti_odometry/sequences/06 --kills 50
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram_lab.programs import command_line

# The child tells when a checkpoint is about to be committed and when it is done.
_CHILD = """
import sys
from pathlib import Path
from sqlalchemy import event
from sqlalchemy.engine import Engine
from engram.monitor import Advancing
from engram.robot.mapping import map_drive
from engram.sequences.opening import open_drive
from engram.maps.writer import RevisionWriter
from engram_lab.there_and_back import ThereAndBack

@event.listens_for(Engine, "commit")
def about_to_commit(connection):
    print("commit", flush=True)

plain = RevisionWriter.checkpoint
def checkpoint(self):
    plain(self)
    print("durable", flush=True)
RevisionWriter.checkpoint = checkpoint

sequence = ThereAndBack(open_drive(Path(sys.argv[2])), int(sys.argv[3]))
def tell(word):
    print("frame", flush=True)
map_drive(Path(sys.argv[1]), sequence, monitor=Advancing(tell))
print("finished", flush=True)
"""


def kill_once(
    drive: Path, frames: int, rng: random.Random, *, within_commit: bool, seal: bool
) -> dict[str, object]:
    """One run that is killed, then resumed or sealed.

    `good`: whether nothing was lost but what no checkpoint had covered.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.engram"
        seen = _run_and_kill(path, drive, frames, rng, within_commit)
        sound = check_file(path).sound
        with Map.open(path) as store:
            interrupted = store.interrupted()
        ended = "not begun"
        if interrupted and seal:
            with Map.open(path, writes=True) as store:
                store.seal(interrupted[0].session.id)
            ended = "sealed"
        elif interrupted:
            command = [sys.executable, "-c", _CHILD, str(path), str(drive), str(frames)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            ended = "resumed"
        return {
            "good": sound and check_file(path).sound,
            "within_commit": within_commit,
            "frames": seen["frame"],
            "frames_since_checkpoint": seen["since"],
            "nodes": interrupted[0].nodes if interrupted else 0,
            "ended": ended,
        }


def _run_and_kill(
    path: Path, drive: Path, frames: int, rng: random.Random, within_commit: bool
) -> dict[str, int]:
    """Runs the child and kills it at a random frame, or within a random commit."""
    kill_at = rng.randrange(1, frames)
    delay_s = rng.uniform(0.0, 0.003 if within_commit else 0.05)
    seen, due = {"frame": 0, "since": 0}, False
    command = [sys.executable, "-c", _CHILD, str(path), str(drive), str(frames)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            word = line.strip()
            seen["frame"] += word == "frame"
            seen["since"] = 0 if word == "durable" else seen["since"] + (word == "frame")
            if not due and seen["frame"] >= kill_at and (word == "commit" or not within_commit):
                # Kills from a thread, so that the child is not held up by a full pipe meanwhile.
                threading.Timer(delay_s, child.send_signal, [signal.SIGKILL]).start()
                due = True
    return seen


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--within-commit", type=int, default=10)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    good = 0
    for number in range(asked.kills):
        kill = kill_once(
            asked.drive,
            asked.frames,
            random.Random(f"{asked.seed} {number}"),
            within_commit=number < asked.within_commit,
            seal=number % 2 == 1,
        )
        good += bool(kill["good"])
        print(json.dumps({"number": number, **kill}), flush=True)
    print(f"{good} of {asked.kills} open, pass check, and were resumed or sealed")
    sys.exit(good != asked.kills)


if __name__ == "__main__":
    main()
