"""Memory while a long bag is read: at its end, less that at a tenth of it.

    python -m engram_lab.checks.bag_memory [--gigabytes 2] [--kind mcap]

Raw pairs of 752×480 are written as a bag and read as a drive. Ends with 1 if the memory of the
process grew by more than 50 MB.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from engram.calibration.calibrated_pair import Cameras
from engram.calibration.toml import calibration_toml
from engram.geometry.cameras import StereoCamera
from engram.sequences.opening import open_drive
from engram_lab.checks.euroc_bag import Pictures, write_bag

_WIDTH, _HEIGHT = 752, 480
_MOST_MB = 50.0


def pictures(count: int) -> Iterator[Pictures]:
    """Pairs at 20 Hz, ten pictures again and again."""
    rng = np.random.default_rng(0)
    known = [rng.integers(0, 256, (_HEIGHT, _WIDTH), np.uint8) for _ in range(10)]
    for number in range(count):
        yield 10**18 + number * 50_000_000, known[number % 10], known[(number + 1) % 10]


def resident_mb() -> float:
    """Memory that the process has now, MB."""
    line = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if "VmRSS" in line
    )
    return float(line.split()[1]) / 1024


def main() -> int:
    """Prints both figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--gigabytes", type=float, default=2.0)
    parser.add_argument("--kind", choices=["ros1", "sqlite3", "mcap"], default="mcap")
    asked = parser.parse_args()
    count = int(asked.gigabytes * 1e9 / (2 * _WIDTH * _HEIGHT))
    with tempfile.TemporaryDirectory(prefix="engram-memory-") as name:
        folder = Path(name)
        bag = write_bag(folder / "bag", pictures(count), asked.kind)
        calibration = folder / "calibration.toml"
        camera = StereoCamera(450, 450, 376, 240, 0.1, _WIDTH, _HEIGHT)
        calibration.write_text(calibration_toml(Cameras(camera)))
        at_tenth_mb = 0.0
        read = 0
        for _ in open_drive(bag, calibration=calibration):
            read += 1
            if read == count // 10:
                at_tenth_mb = resident_mb()
        at_end_mb = resident_mb()
        size = sum(one.stat().st_size for one in ([bag] if bag.is_file() else bag.iterdir()))
    print(
        f"{read} of {count} pairs, {size / 1e9:.2f} GB as {asked.kind}: {at_tenth_mb:.0f} MB after "
        f"a tenth, {at_end_mb:.0f} MB at the end, {at_end_mb - at_tenth_mb:+.1f} MB"
    )
    return int(read < count or at_end_mb - at_tenth_mb > _MOST_MB)


if __name__ == "__main__":
    sys.exit(main())
