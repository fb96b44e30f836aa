"""Corners and scenes by which kinds of features are compared under changing light and weather."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path
from scipy.spatial import cKDTree

from engram import _core
from engram.frontend.frame import Frame, Landmarks, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.monitor import QUIET, Monitor
from engram.sequences.opening import open_drive
from engram_lab.town.campaigns import WORLD_VERSION
from engram_lab.town.drive import robot_named
from engram_lab.town.rendering import VISITS, Places, Visit, at

PATCH_PX = 64
_HALF = PATCH_PX // 2
# A corner counts as the same within so many pixels of its octave, with disparities that agree to
# within their noise, and patches whose metric sizes differ by less than one octave.
_SAME_PX = 1.5
_DISPARITY_PX, _DISPARITY_SHARE = 0.35, 0.04
_SIZES = 1.9


def same_corners(
    a: Landmarks,
    b: Landmarks,
    b_from_a: NDArray[np.float64],
    camera: StereoCamera,
    within_px: float = _SAME_PX,
) -> NDArray[np.int64]:
    """Rows (M, 2) of landmarks of `a` and of `b` that show the same corner.

    Args:
        b_from_a: (4, 4), true pose of the one camera in the other.
    """
    points = a.points_in_cam.astype(np.float64) @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    seen = np.flatnonzero(points[:, 2] > 0.5)
    depth_m = points[seen, 2]
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    pixels = focal * points[seen, :2] / depth_m[:, None] + middle
    if not len(seen) or not len(b):
        return np.empty((0, 2), np.int64)
    largest = 2.0 ** max(a.octaves.max(), b.octaves.max())
    near = cKDTree(pixels).sparse_distance_matrix(
        cKDTree(b.pixels.astype(np.float64)), within_px * largest, output_type="ndarray"
    )
    row, j, away_px = near["i"], near["j"], near["v"]
    i = seen[row]
    scale_a, scale_b = 2.0 ** a.octaves[i], 2.0 ** b.octaves[j]
    scale = np.maximum(scale_a, scale_b)
    disparity_px = camera.fx * camera.baseline_m / depth_m[row]
    slack_px = _DISPARITY_PX + _DISPARITY_SHARE * b.disparity_px[j]
    sizes = depth_m[row] * scale_a / (b.points_in_cam[j, 2] * scale_b)
    good = (away_px <= within_px * scale) & (np.abs(disparity_px - b.disparity_px[j]) <= slack_px)
    good &= (sizes < _SIZES) & (sizes > 1 / _SIZES)
    return _mutual(i[good], j[good], (away_px / scale)[good])


def _mutual(
    i: NDArray[np.int64], j: NDArray[np.int64], cost: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Of the pairs (i, j), those that are the cheapest of both i and j."""
    order = np.argsort(cost, kind="stable")
    i, j = i[order], j[order]
    first_i, first_j = (np.zeros(len(order), bool) for _ in range(2))
    first_i[np.unique(i, return_index=True)[1]] = True
    first_j[np.unique(j, return_index=True)[1]] = True
    both = first_i & first_j
    return np.stack([i[both], j[both]], axis=1).astype(np.int64)


class Patches:
    """Cuts patches around the corners of an image, at the octave of each.

    Args:
        image: (h, w) uint8.
    """

    def __init__(self, image: NDArray[np.uint8], octaves: int = 2) -> None:
        level, self._levels = np.ascontiguousarray(image), []
        for octave in range(octaves):
            level = _core.halve(level) if octave else level
            padded = np.pad(level, _HALF, mode="edge")
            self._levels.append(np.lib.stride_tricks.sliding_window_view(padded, (64, 64)))

    def around(self, pixels: NDArray[np.float32], octaves: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Patches (N, 64, 64) uint8, the corner at [32, 32].

        Args:
            pixels: (N, 2) float32, u, v, px of the full-size image.
            octaves: (N,) uint8.
        """
        out = np.empty((len(pixels), PATCH_PX, PATCH_PX), np.uint8)
        for octave, level in enumerate(self._levels):
            here = octaves == octave
            x, y = corner_at(pixels[here], octave).T
            out[here] = level[y, x]
        return out


def corner_at(pixels: NDArray[np.float32], octave: int) -> NDArray[np.int64]:
    """Pixels (N, 2) of an octave's image nearest to points of the full-size one."""
    centres: NDArray[np.int64] = np.rint((pixels + 0.5) / 2**octave - 0.5).astype(np.int64)
    return centres


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
        world_from_cam: (V, K, 4, 4) float64, true poses of the left camera.
        left, right: (V, K, h, w) uint8 images.
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
