"""One place of a town in every condition, as one picture.

python -m engram_lab.roads.pictures town_conditions.jpg [--town 4]
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram_lab.programs import command_line
from engram_lab.roads.seasons import CONDITIONS, OVERCAST
from engram_lab.town.camera_model import CLEAN, Lens
from engram_lab.town.glass import Glass
from engram_lab.town.rendering import Places, Visit, at

_ACROSS = 4
_SIZE_PX = (320, 240)
_RAIN = next(one.visit for one in CONDITIONS if one.visit.name == "rain")
_SHOWN: tuple[tuple[Visit, Lens], ...] = (
    (OVERCAST, CLEAN),
    *((one.visit, CLEAN) for one in CONDITIONS),
    (Visit("low sun", at(7, 16, 18.5), "clear", 16), CLEAN),
    (replace(_RAIN, name="rain, 12 mm/h", rain_mm_h=12.0), CLEAN),
    (replace(_RAIN, name="rain, unwiped pane"), Lens(glass=Glass(distance_mm=40.0))),
)


def tile(image: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """A picture in small with its name above it."""
    small = cv2.resize(image, _SIZE_PX, interpolation=cv2.INTER_AREA)
    small[:20] = 32
    place, font = (6, 15), cv2.FONT_HERSHEY_SIMPLEX
    return np.asarray(cv2.putText(small, name, place, font, 0.5, 255, 1, cv2.LINE_AA), np.uint8)


def sheet(town: int, at_m: float) -> NDArray[np.uint8]:
    """All conditions at one place of a town's loop."""
    tiles = []
    for visit, lens in _SHOWN:
        places = Places(town, every_m=1e6, lens=lens)
        ((_, pair),) = places.pairs(visit, at_m)
        tiles.append(tile(pair.left, visit.name))
    rows = [np.hstack(tiles[k : k + _ACROSS]) for k in range(0, len(tiles), _ACROSS)]
    return np.vstack(rows)


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument("out", type=Path, help="JPEG or PNG")
    parser.add_argument("--town", type=int, default=4)
    parser.add_argument("--at", type=float, default=20.0, metavar="M", help="along the loop")
    asked = parser.parse_args()
    if not cv2.imwrite(str(asked.out), sheet(asked.town, asked.at)):
        raise SystemExit(f"{asked.out}: cannot be written")


if __name__ == "__main__":
    main()
