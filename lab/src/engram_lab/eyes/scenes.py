"""Places of rendered towns under many lights, rendered once and kept in the user's cache."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from engram.frontend import Frame, Frontend, FrontendConfig, Landmarks, StereoPair
from engram.geometry import StereoCamera
from engram.monitor import QUIET, Monitor
from engram.sequences import open_drive
from engram_lab.town.campaigns import WORLD_VERSION
from engram_lab.town.robots import robot_named
from engram_lab.town.visits import VISITS, Places, Visit, at

_KEPT = ("pixels", "disparity_px", "disparity_sigma_px", "points_in_cam", "octaves")

JUDGED = {
    **{name: VISITS[name] for name in ("morning", "late afternoon", "overcast", "night", "snow")},
    "rain": Visit("rain", at(7, 16, 11.0), "rain", 16),
    "rain at night": Visit("rain at night", at(7, 16, 23.5), "rain", 16),
    "fog": Visit("fog", at(7, 17, 5.5), "fog", 17),
    "thaw": Visit("thaw", at(12, 29, 13.0), "thaw", 181),
    "rain again": Visit("rain again", at(7, 18, 15.0), "rain", 18),
}

# How many visits of a training town, in which months, at which hours, in which of these weathers.
_DRAWN = (
    (4, (4, 10), (6.5, 17.5), ("clear", "fair")),
    (1, (4, 10), (9, 15), ("broken",)),
    (2, (4, 10), (8, 16), ("overcast", "damp")),
    (3, (5, 9), (22.3, 25.5), ("fair", "clear", "overcast")),
    (2, (1, 3), (9, 15), ("snow",)),
    (1, (1, 3), (9, 15), ("thaw",)),
    (1, (1, 3), (10, 14), ("clear",)),
    (2, (4, 10), (8, 17), ("rain",)),
    (1, (5, 9), (22.5, 25), ("rain",)),
    (1, (4, 10), (8, 16), ("showers",)),
    (1, (6, 8), (4.5, 8), ("fog",)),
)
# Rows of these visits, which training draws more often.
WET, DARK = (14, 15, 16, 17), (7, 8, 9, 16)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Places (K) on several visits (V), all by one camera.

    Attributes:
        name: of the town and what it is for.
        camera: of all pairs.
        visits: their names.
        world_from_cam: (V, K, 4, 4) float64, true poses of the left camera.
        left, right: (V, K, h, w) uint8 images.
        landmarks: of each (visit, place), without descriptors.
    """

    name: str
    camera: StereoCamera
    visits: tuple[str, ...]
    world_from_cam: NDArray[np.float64]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    landmarks: dict[tuple[int, int], Landmarks]

    def pair(self, visit: int, place: int) -> StereoPair:
        """The images of a place."""
        left, right = (np.ascontiguousarray(each[visit, place]) for each in (self.left, self.right))
        return StereoPair(1000 * visit + place + 1, left, right, self.camera)

    def frames(self, frontend: Frontend) -> dict[tuple[str, int], Frame]:
        """What a front-end makes of each visit, by its name, and place."""
        return {
            (name, place): frontend.extract(self.pair(visit, place))
            for visit, name in enumerate(self.visits)
            for place in range(self.left.shape[1])
        }


def drawn_visits(seed: int) -> dict[str, Visit]:
    """Hours and dates drawn again for each town, so that none is one that is judged."""
    draws, visits, day = np.random.default_rng(seed), {}, 300
    for count, months, hours, weathers in _DRAWN:
        for _ in range(count):
            day += 1
            weather, hour = str(draws.choice(weathers)), float(draws.uniform(*hours))
            start = at(int(draws.integers(*months)), int(draws.integers(1, 28)), hour)
            visits[f"{weather} {day}"] = Visit(f"{weather} {day}", start, weather, day)
    return visits


def training_scene(seed: int, robot: str = "wildcat", monitor: Monitor = QUIET) -> Scene:
    """A town's places every 5 m on 19 visits, each moved by up to 0.7 m ahead and 0.5 m aside."""
    places, visits = Places(seed, robot=robot, every_m=5.0), drawn_visits(seed)
    draws = np.random.default_rng(seed + 1)
    moves_m = {
        name: (draws.uniform(-0.7, 0.7, len(places)), draws.uniform(-0.5, 0.5, len(places)))
        for name in visits
    }
    return _kept(f"training-{seed}-{robot}", places, visits, moves_m, monitor)


def judged_scene(seed: int, monitor: Monitor = QUIET) -> Scene:
    """A town's places every 5 m: the morning, and other visits 0.4 m ahead and 0.3 m aside."""
    places = Places(seed)
    moves_m = {name: np.tile([[0.4], [0.3]], len(places)) for name in JUDGED}
    moves_m["morning"][:] = 0
    return _kept(f"judged-{seed}", places, JUDGED, {n: (m[0], m[1]) for n, m in moves_m.items()},
                 monitor)  # fmt: skip


def clip(folder: Path, rig: str = "grey", channel: str = "grey") -> list[StereoPair]:
    """The stereo pairs of a real clip; for the cameras see `open_drive`."""
    drive = open_drive(folder, rig=rig, channel=channel)
    return [pair for pair in drive if isinstance(pair, StereoPair)]


def scenes_folder() -> Path:
    """Where scenes are kept."""
    return user_cache_path("engram") / "scenes"


Moves = Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def _kept(
    name: str, places: Places, visits: Mapping[str, Visit], moves_m: Moves, monitor: Monitor
) -> Scene:
    folder = scenes_folder() / f"{name}-v{WORLD_VERSION}"
    if not (folder / "landmarks.npz").exists():  # which is written last
        folder.mkdir(parents=True, exist_ok=True)
        _render(folder, places, visits, moves_m, monitor)
    poses, left, right = (
        np.load(folder / f"{part}.npy", mmap_mode="r") for part in ("poses", "left", "right")
    )
    stored = np.load(folder / "landmarks.npz")
    arrays = [np.split(stored[part], np.cumsum(stored["counts"])[:-1]) for part in _KEPT]
    rows = {
        key: [array[row] for array in arrays] for row, key in enumerate(np.ndindex(left.shape[:2]))
    }
    landmarks = {
        key: Landmarks(one[0], one[1], one[2], one[3], np.zeros((len(one[0]), 0), np.uint8), one[4])
        for key, one in rows.items()
    }
    camera = robot_named(places.robot.name).camera
    return Scene(name, camera, tuple(visits), np.asarray(poses), left, right, landmarks)


def _render(
    folder: Path, places: Places, visits: Mapping[str, Visit], moves_m: Moves, monitor: Monitor
) -> None:
    camera = places.robot.camera
    shape = (len(visits), len(places), camera.height, camera.width)
    left, right = (
        np.lib.format.open_memmap(folder / f"{part}.npy", "w+", np.uint8, shape)
        for part in ("left", "right")
    )
    poses = np.empty((*shape[:2], 4, 4))
    frontend, found = Frontend(FrontendConfig(thumbnails=False)), []
    for row, (name, visit) in enumerate(visits.items()):
        for place, (world_from_cam, pair) in enumerate(places.pairs(visit, *moves_m[name])):
            poses[row, place] = world_from_cam.matrix()
            left[row, place], right[row, place] = pair.left, pair.right
            found.append(frontend.extract(replace(pair, stamp_ns=place + 1)).landmarks)
        monitor.advance(f"{folder.name} {name}")
    np.save(folder / "poses.npy", poses)
    kept: dict[str, Any] = {
        part: np.concatenate([getattr(one, part) for one in found]) for part in _KEPT
    }
    left.flush()
    right.flush()
    np.savez(folder / "landmarks.npz", counts=[len(one) for one in found], **kept)
