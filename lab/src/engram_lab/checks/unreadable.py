"""Unreadable inputs: each ends with a message and an exit status, soon, in little memory.

    python -m engram_lab.checks.unreadable [--times 50]

Bags of every container are cut at random places; others hold nothing of use, another robot's
topics, images declared 100,000 pixels wide, a kilobyte that unpacks to gigabytes; calibrations are
YAML that doubles itself, pipes, circles of links. Each goes through `engram map` in a process of
its own. A cut bag may be mapped as far as it goes; it then says what was lost and ends with 3.

Ends with 1 if a status is 0, a message is missing or a traceback, or a process takes more than ten
seconds of CPU or a gigabyte.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram_lab.checks.euroc_bag import Pictures, write_bag

_MOST_S, _MOST_BYTES = 10.0, 1 << 30
# A process that waits for ever.
_PATIENCE_S = 600.0
_LEFT, _RIGHT = "/cam0/image_raw", "/cam1/image_raw"
_INFO = """image_width: 320
image_height: 240
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
camera_matrix: {{rows: 3, cols: 3, data: [200, 0, 160, 0, 200, 120, 0, 0, 1]}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [200, 0, 160, {}, 0, 200, 120, 0, 0, 0, 1, 0]}}
"""


@dataclass(frozen=True, slots=True)
class Ended:
    """How a process ended.

    Attributes:
        status: of its exit; negative if it was killed.
        said: what it said on the error channel.
        cpu_s: CPU time.
        wall_s: from its start to its end.
        most_bytes: its largest memory.
    """

    status: int
    said: str
    cpu_s: float
    wall_s: float
    most_bytes: int

    @property
    def fault(self) -> str:
        """What is wrong with it; "" if nothing is."""
        if self.status <= 0:
            return f"ended with {self.status}"
        if "Traceback" in self.said or not self.said.strip():
            return "a traceback" if self.said.strip() else "no message"
        if self.cpu_s > _MOST_S:
            return f"{self.cpu_s:.1f} s"
        return f"{self.most_bytes >> 20} MB" if self.most_bytes > _MOST_BYTES else ""


def tried(*arguments: str) -> Ended:
    """Runs `engram` and waits for its end."""
    command = [sys.executable, "-c", "from engram.cli import main; main()", *arguments]
    began = time.monotonic()
    with tempfile.TemporaryFile() as heard:
        process = subprocess.Popen(
            ["timeout", str(_PATIENCE_S), *command], stdout=subprocess.DEVNULL, stderr=heard
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        heard.seek(0)
        said = heard.read().decode(errors="replace")
    wall_s = time.monotonic() - began
    code = -1 if process.returncode == 124 else process.returncode
    return Ended(code, said, used.ru_utime + used.ru_stime, wall_s, used.ru_maxrss * 1024)


def pictures(count: int, side: tuple[int, int] = (240, 320)) -> Iterator[Pictures]:
    """Pairs of noise at 20 Hz."""
    rng = np.random.default_rng(0)
    for number in range(count):
        left, right = (rng.integers(0, 256, side, np.uint8) for _ in range(2))
        yield 10**18 + number * 50_000_000, left, right


def cases(folder: Path, times: int) -> Iterator[tuple[str, list[str]]]:
    """Name, and arguments of `engram map`, of each input."""
    calibration = folder / "left.yaml"
    calibration.write_text(_INFO.format(0))
    (folder / "right.yaml").write_text(_INFO.format(-100))
    given = ["--calibration", str(calibration)]
    whole = {kind: _whole(folder, kind) for kind in ("ros1", "sqlite3", "mcap")}
    rng = np.random.default_rng(1)
    for bag in whole.values():
        content = bag.read_bytes()
        for number in range(times):
            cut = folder / f"cut{number}{bag.suffix}"
            cut.write_bytes(content[: int(rng.integers(len(content)))])
            yield f"{bag.suffix} cut at a random place", [str(cut), *given]
    for bag in whole.values():
        yield "topics of another robot", [str(bag), "--left", "/other", "--right", "/rig", *given]
        yield "no calibration", [str(bag)]
    yield from _odd_bags(folder, given)
    for name, made in _odd_files(folder):
        yield name, [str(made)]
        yield f"{name} as calibration", [str(whole["mcap"]), "--calibration", str(made)]


def _whole(folder: Path, kind: str) -> Path:
    made = write_bag(folder / kind, pictures(30), kind)
    return made if made.is_file() else next(one for one in made.iterdir() if one.suffix != ".yaml")


def _odd_bags(folder: Path, given: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Bags that can be read and not used."""
    for kind in ("ros1", "sqlite3", "mcap"):
        huge = write_bag(folder / f"huge-{kind}", pictures(10), kind, declared=100_000)
        yield "images declared 100,000 × 100,000", [str(huge), *given]
        other = write_bag(folder / f"other-{kind}", pictures(10, (120, 160)), kind)
        yield "images of another size than the calibration", [str(other), *given]
        words = write_bag(folder / f"words-{kind}", pictures(10), kind, words=True)
        yield "text in place of images", [str(words), *given]


def _odd_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Files that are not what their names say."""
    doubling = ["a0: &a0 [0, 0, 0, 0, 0, 0, 0, 0, 0]"]
    doubling += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 30)]
    (folder / "bomb.yaml").write_text("\n".join(doubling))
    yield "YAML that doubles itself", folder / "bomb.yaml"
    zeros = b"\0" * (1 << 20)
    for suffix in (".bag.zstd", ".mcap.zstd", ".db3.zstd"):
        bomb = folder / f"bomb{suffix}"
        with (
            bomb.open("wb") as file,
            subprocess.Popen(["zstd", "-q"], stdin=subprocess.PIPE, stdout=file) as packing,
        ):
            assert packing.stdin is not None
            for _ in range(4096):
                packing.stdin.write(zeros)
            packing.stdin.close()
        yield "4 GB of zeros, packed", bomb
    for suffix in (".bag", ".mcap", ".db3", ".yaml"):
        pipe = folder / f"pipe{suffix}"
        os.mkfifo(pipe)
        yield "a pipe that nobody writes", pipe
        circle = folder / f"circle{suffix}"
        circle.symlink_to(circle)
        yield "a link to itself", circle
        noise = folder / f"noise{suffix}"
        noise.write_bytes(np.random.default_rng(2).bytes(1 << 20))
        yield "noise", noise
        empty = folder / f"empty{suffix}"
        empty.touch()
        yield "an empty file", empty


def main() -> int:
    """Prints one row for each kind of input."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--times", type=int, default=50, help="cut bags of each container")
    asked = parser.parse_args()
    rows: dict[str, list[Ended]] = defaultdict(list)
    faults = 0
    with tempfile.TemporaryDirectory(prefix="engram-unreadable-") as name:
        folder = Path(name)
        for number, (kind, arguments) in enumerate(cases(folder, asked.times)):
            one = tried("map", str(folder / f"{number}.engram"), *arguments)
            rows[kind].append(one)
            faults += bool(one.fault)
            if " cut " in kind and not re.search("lost|cut short|damaged|no message", one.said):
                faults += 1
                print(f"{kind}: nothing says so: {arguments}\n{one.said[-600:]}", flush=True)
            if one.fault:
                print(f"{kind}: {one.fault}: {arguments}\n{one.said[-600:]}", flush=True)
    print("| input | times | exit status | s of CPU, most | s, most | MB, most |\n|" + " --- |" * 6)
    for kind, ended in rows.items():
        statuses = ", ".join(str(one) for one in sorted({one.status for one in ended}))
        most_s = max(one.cpu_s for one in ended)
        most_mb = max(one.most_bytes for one in ended) >> 20
        longest_s = max(one.wall_s for one in ended)
        print(
            f"| {kind} | {len(ended)} | {statuses} | {most_s:.1f} | {longest_s:.1f} | {most_mb} |"
        )
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
