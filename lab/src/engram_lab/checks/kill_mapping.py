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
import time
from dataclasses import asdict, dataclass
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


@dataclass
class Kill:
    """One run that was killed.

    Attributes:
        within_commit: whether the kill was aimed into a commit.
        frames: live frames processed before it.
        frames_since_checkpoint: of them, those that no checkpoint had covered.
        nodes: nodes that the map holds of the session.
        sound: whether `check` found nothing.
        shown_interrupted: whether the map shows the session as interrupted.
        ended: "resumed", "sealed", or "not begun" where nothing had been written yet.
        sound_after: whether `check` found nothing after that.
    """

    within_commit: bool
    frames: int
    frames_since_checkpoint: int
    nodes: int
    sound: bool
    shown_interrupted: bool
    ended: str
    sound_after: bool

    @property
    def good(self) -> bool:
        """Whether nothing was lost but what no checkpoint had covered."""
        began = self.shown_interrupted or self.ended == "not begun"
        return self.sound and self.sound_after and began


def kill_once(
    drive: Path, frames: int, rng: random.Random, within_commit: bool, seal: bool
) -> Kill:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.engram"
        seen = _run_and_kill(path, drive, frames, rng, within_commit)
        sound = check_file(path).sound
        with Map.open(path) as store:
            interrupted = store.interrupted()
        nodes = interrupted[0].nodes if interrupted else 0
        ended = "not begun"
        if interrupted and seal:
            with Map.open(path, writes=True) as store:
                store.seal(interrupted[0].session.id)
            ended = "sealed"
        elif interrupted:
            command = [sys.executable, "-c", _CHILD, str(path), str(drive), str(frames)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            ended = "resumed"
        return Kill(
            within_commit,
            seen["frame"],
            seen["since"],
            nodes,
            sound,
            bool(interrupted),
            ended,
            check_file(path).sound,
        )


def _run_and_kill(
    path: Path, drive: Path, frames: int, rng: random.Random, within_commit: bool
) -> dict[str, int]:
    """Runs the child and kills it at a random frame, or within a random commit."""
    kill_at = rng.randrange(1, frames)
    delay_s = rng.uniform(0.0, 0.003 if within_commit else 0.05)
    seen = {"frame": 0, "since": 0}
    command = [sys.executable, "-c", _CHILD, str(path), str(drive), str(frames)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            word = line.strip()
            if word == "frame":
                seen["frame"] += 1
                seen["since"] += 1
            elif word == "durable":
                seen["since"] = 0
            due = seen["frame"] >= kill_at
            if due and (word == "commit" if within_commit else True):
                # Kills from a thread, so that the child is not held up by a full pipe meanwhile.
                threading.Timer(delay_s, child.send_signal, [signal.SIGKILL]).start()
                break
        for line in child.stdout:
            seen["frame"] += line.strip() == "frame"
            seen["since"] = 0 if line.strip() == "durable" else seen["since"] + (line == "frame\n")
    return seen


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--within-commit", type=int, default=10)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None, help="one JSON line per kill, resumable")
    arguments = parser.parse_args()
    done = 0
    good = 0
    if arguments.out is not None and arguments.out.exists():
        for line in arguments.out.read_text().splitlines():
            done, good = done + 1, good + json.loads(line)["good"]
    for number in range(done, arguments.kills):
        rng = random.Random(f"{arguments.seed} {number}")
        started = time.monotonic()
        kill = kill_once(
            arguments.drive,
            arguments.frames,
            rng,
            within_commit=number < arguments.within_commit,
            seal=number % 2 == 1,
        )
        good += kill.good
        record = {"number": number, "good": kill.good, **asdict(kill)}
        print(json.dumps({**record, "seconds": round(time.monotonic() - started, 1)}), flush=True)
        if arguments.out is not None:
            with arguments.out.open("a") as out:
                out.write(json.dumps(record) + "\n")
    print(f"{good} of {arguments.kills} open, pass check, and were resumed or sealed")
    sys.exit(good != arguments.kills)


if __name__ == "__main__":
    main()
