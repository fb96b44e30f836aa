"""Renders the two drives that ship with Engram for `engram try`.

    python -m engram_lab.demo.sample_drives src/engram/sample/data

Both are parts of drives of the campaign `hamlet`, of one robot: from the start of its first drive,
in the sun, and of its second, on the next day under clouds. The second part begins further on and
ends further on, so that the last of it is not in a map of the first. The same program writes the
same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import Cameras
from engram.calibration.toml import calibration_toml
from engram.frontend.frame import StereoPair
from engram.sequences.motion_files import Trajectory, write_tum
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

_CAMPAIGN = "hamlet"
_ZONE = "Europe/London"
# Of 1 to 100. As PNG the drives are 16 MB, so 6.0 MB; 33 of 40 frames are localised.
_QUALITY = 90
_JPEG = (
    cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1,
    cv2.IMWRITE_JPEG_PROGRESSIVE, 1,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class SamplePart:
    """The part of a campaign's drive that ships."""

    session: int
    first: int
    last: int

    def drive(self) -> SimulatedDrive:
        """The whole drive."""
        return SimulatedDrive(campaign_named(_CAMPAIGN), self.session)

    def pairs(self, count: int | None = None) -> Iterator[StereoPair]:
        """The pairs of the part, or the first `count` of them."""
        last = self.last if count is None else self.first + count
        return self.drive().frames(self.first, last)


PARTS = {"monday": SamplePart(0, 0, 40), "tuesday": SamplePart(2, 10, 50)}


def write_facts(part: SamplePart, folder: Path) -> None:
    """Writes all but the images: calibration and stamps, and the truth next to the folder."""
    drive, frames = part.drive(), range(part.first, part.last)
    about = (
        f"A simulated drive, rendered by engram-lab: {drive.plan.name} of the campaign "
        f"{_CAMPAIGN}, frames {part.first} to {part.last - 1}."
    )
    facts = [
        f"# {about}", 'clock = "utc"', f'robot = "{drive.plan.robot}"', f'zone = "{_ZONE}"', ""
    ]  # fmt: skip
    stamps_ns = [drive.stamp_ns(frame) for frame in frames]
    times = [f"{one // 10**9}.{one % 10**9:09d}\n" for one in stamps_ns]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration.toml").write_text(
        "\n".join(facts) + "\n" + calibration_toml(Cameras(drive.camera)), encoding="utf-8"
    )
    (folder / "times.txt").write_text("".join(times), encoding="utf-8")
    poses = drive.world_from_cams()[part.first : part.last]
    truth = Trajectory(np.array(stamps_ns, np.int64), poses)
    write_tum(folder.with_suffix(".truth.txt"), truth, [about])


def encoded(image: NDArray[np.uint8]) -> bytes:
    """An image, (h, w) uint8, as the JPEG that ships."""
    return cv2.imencode(".jpg", image, _JPEG)[1].tobytes()


def write_images(part: SamplePart, folder: Path) -> None:
    """Renders a part's images into `left/` and `right/`."""
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True, exist_ok=True)
    for number, pair in enumerate(part.pairs()):
        for side, image in (("left", pair.left), ("right", pair.right)):
            (folder / side / f"{number:06d}.jpg").write_bytes(encoded(image))


def main() -> None:
    """Renders both parts into a folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where they are written")
    folder = parser.parse_args().folder
    for name, part in PARTS.items():
        write_facts(part, folder / name)
        write_images(part, folder / name)
        print(f"{folder / name}: {part.last - part.first} pairs", flush=True)


if __name__ == "__main__":
    main()
