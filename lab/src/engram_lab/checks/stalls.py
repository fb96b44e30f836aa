"""False fixes after a camera stalls or freezes, on a drive with truth, localised in its own map.

python -m engram_lab.checks.stalls                      # KITTI 06 of ENGRAM_DATA, all three maps
python -m engram_lab.checks.stalls --fine --json stalls.json

A fix is false that is more than 1 m off.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import engram
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.sequences.layouts import ImageSequence
from engram.sequences.sequence import StereoSequence
from engram_lab.programs import Figure, command_line, report

KITTI_06 = "kitti_odometry/sequences/06"
KITTI_06_TRUTH = "kitti_odometry/poses/06.txt"
FALSE_M = 1.0
# The maps: of the whole drive, of every other frame, of its first half.
MAPS = {"whole": None, "every other frame": "0::2", "first half": "0:25"}


@dataclass
class Tally:
    """Results of drives with a fault.

    Attributes:
        tries: how many there were.
        fixes: frames that were localised.
        false: of those more than `FALSE_M` off.
        hurt: tries with any.
        worst_m: the largest error of a fix.
        again: frames until the first right fix after the fault, for each try that had one.
    """

    tries: int = 0
    fixes: int = 0
    false: int = 0
    hurt: int = 0
    worst_m: float = 0.0
    again: list[int] | None = None

    def count(self, errors_m: dict[int, float], frames: Sequence[int], after: int) -> None:
        """One try: errors of its fixes, by frame; frames from `after` on follow the fault."""
        wrong = [error for error in errors_m.values() if error > FALSE_M]
        self.tries += 1
        self.fixes += len(errors_m)
        self.false += len(wrong)
        self.hurt += bool(wrong)
        self.worst_m = max([self.worst_m, *errors_m.values()])
        behind = [frame for frame in frames if frame >= after]
        right = [k for k, frame in enumerate(behind) if errors_m.get(frame, np.inf) <= FALSE_M]
        self.again = [*(self.again or []), *right[:1]]


class Clip:
    """A drive with truth, mapped by itself.

    Args:
        pairs: its frames.
        world_from_cam: the truth, one pose a frame.
        path: the map, NAME.engram, made here.
        mapped: which frames are mapped.
    """

    def __init__(
        self,
        pairs: Sequence[StereoPair],
        world_from_cam: Sequence[SE3],
        path: Path,
        mapped: StereoSequence,
    ) -> None:
        self.pairs = pairs
        self._truth = world_from_cam
        engram.map_drive(path, mapped)
        self._town = engram.open_map(path)
        frame_at = {pair.stamp_ns: k for k, pair in enumerate(pairs)}
        self._frame_of = {node.id: frame_at[node.stamp_ns] for node in self._town.graph.nodes}

    def errors_m(self, shown: Iterable[tuple[int, StereoPair]]) -> dict[int, float]:
        """How far off each fix is, by frame, of a robot that is shown these frames."""
        errors = {}
        with self._town.robot(self.pairs[0].camera) as robot:
            for frame, pair in shown:
                found = robot.step(pair)
                if found.node is None or found.node_from_live is None:
                    continue
                node_from_live = (
                    self._truth[self._frame_of[found.node]].inverse() @ (self._truth[frame])
                )
                error = node_from_live.inverse() @ found.node_from_live
                errors[frame] = error.distance_m
        return errors

    def close(self) -> None:
        """Closes the map."""
        self._town.close()


def stalls(clip: Clip, gaps: Iterable[tuple[int, int]]) -> Tally:
    """The camera shows nothing between two frames."""
    tally = Tally()
    for last, again in gaps:
        frames = [*range(last + 1), *range(again, len(clip.pairs))]
        tally.count(clip.errors_m((k, clip.pairs[k]) for k in frames), frames, again)
    return tally


def freezes(clip: Clip, starts: Iterable[int], length: int = 10) -> Tally:
    """Both cameras, or one of them, repeat an image under new stamps."""
    tally = Tally()
    for start in starts:
        for sides in (("left", "right"), ("left",), ("right",)):
            old = clip.pairs[start - 1]
            held = {side: getattr(old, side) for side in sides}
            shown = [
                (k, replace(pair, **held) if start <= k < start + length else pair)
                for k, pair in enumerate(clip.pairs)
            ]
            tally.count(clip.errors_m(shown), range(len(shown)), start + length)
    return tally


def gaps_of(frames: int, *, fine: bool) -> Iterator[tuple[int, int]]:
    """Last frame before and first after each stall: 0.8 to 3.2 s at 10 Hz, or all up to 4 s."""
    starts, lengths = (
        (range(4, 44, 4), range(1, 41)) if fine else (range(4, 40, 6), range(8, 33, 3))
    )
    return ((a, a + gap) for a in starts for gap in lengths if a + gap < frames - 4)


def figures(data: Path, *, fine: bool) -> Iterator[Figure]:
    """A row for each map and fault."""
    pairs = list(_images(data))
    rows = np.loadtxt(data / KITTI_06_TRUTH)[: len(pairs)]
    truth = [SE3.from_matrix(row.reshape(3, 4)) for row in rows]
    with tempfile.TemporaryDirectory(prefix="engram-stalls-") as folder:
        for number, (name, frames) in enumerate(MAPS.items()):
            mapped = _images(data, frames)
            clip = Clip(pairs, truth, Path(folder) / f"{number}.engram", mapped)
            yield from _rows(f"stalls, map of {name}", stalls(clip, gaps_of(len(pairs), fine=fine)))
            yield from _rows(f"freezes, map of {name}", freezes(clip, (10, 20, 30)))
            clip.close()


def _images(data: Path, frames: str | None = None) -> ImageSequence:
    drive = engram.open_drive(data / KITTI_06, frames=frames)
    assert isinstance(drive, ImageSequence)
    return drive


def _rows(name: str, tally: Tally) -> Iterator[Figure]:
    """The figures of one map and fault."""
    again = tally.again or []
    yield Figure(f"{name}: tries", tally.tries)
    yield Figure("  fixes", tally.fixes)
    yield Figure("  of them false", tally.false)
    yield Figure("  tries with false fixes", tally.hurt)
    yield Figure("  largest error of a fix", tally.worst_m, "m")
    yield Figure("  never found again", tally.tries - len(again))
    yield Figure("  found again after (median)", float(np.median(again or [0])), "frames")
    yield Figure("  found again after (worst)", max(again, default=0), "frames")


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--fine", action="store_true", help="all gaps up to 4 s")
    asked = parser.parse_args()
    if not os.environ.get("ENGRAM_DATA"):
        parser.error("set ENGRAM_DATA to the folder of the real images")
    data = Path(os.environ["ENGRAM_DATA"])
    report(figures(data, fine=asked.fine), asked.json, "false fixes after stalls and freezes")


if __name__ == "__main__":
    main()
