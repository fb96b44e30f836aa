"""Protocol R: a map of an overcast day against every other condition, as RobotCar Seasons does it.

    python -m engram_lab.roads.seasons [--towns 501,502,503] [--every 3] [--only rain,night]

OpenCV's SIFT with the ratio test, PnP with RANSAC, one picture at a time against the four nearest
frames of the map, as retrieval there nearly gives them. What counts is the share within 5 m and
10° and its difference to another overcast day. Towns 501 to 503 are for judging: nothing is ever
tuned on them.

The road's differences are those of SIFT, ratio test and NetVLAD retrieval on RobotCar Seasons'
training split, by condition.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.town.conditions import World
from engram_lab.town.rendering import Places, Visit, at

JUDGED = (501, 502, 503)
_AHEAD_M = _ASIDE_M = 0.35  # of a live picture from its place in the map
_MAP_FRAMES = 4
_RATIO, _STEREO_RATIO = 0.8, 0.85
_CORNERS = 4096
_PNP_PX, _LEAST_INLIERS = 4.0, 6
_NEAR_M, _NEAR_DEG = 5.0, 10.0

MAP = Visit("map", at(7, 15, 11.0), "overcast", 15)
OVERCAST = Visit("overcast", at(7, 22, 14.0), "overcast", 22)


@dataclass(frozen=True, slots=True)
class Against:
    """A condition and what the road loses by it.

    Attributes:
        visit: when.
        road: its share within 5 m and 10° less that of an overcast day, points.
    """

    visit: Visit
    road: float


CONDITIONS = tuple(
    Against(Visit(name, start, weather, day), road)
    for name, start, weather, day, road in (
        ("rain", at(7, 17, 11.0), "rain", 17, -2),
        ("snow", datetime(2025, 12, 28, 11, tzinfo=UTC), "snow", 180, -5),
        ("sun at 9 h", at(7, 16, 8.0), "clear", 16, -12),
        ("sun at 16 h", at(7, 16, 15.0), "clear", 16, -12),
        ("dusk", at(7, 20, 20.55), "fair", 20, -6),
        ("winter", datetime(2025, 12, 10, 11, tzinfo=UTC), "overcast", 500, -7),
        ("night", at(7, 21, 23.0), "fair", 21, -78),
        ("night in rain", at(7, 23, 23.0), "rain", 23, -79),
    )
)


@dataclass(frozen=True, slots=True, eq=False)
class MapFrame:
    """What SIFT keeps of a place.

    Attributes:
        words: (N, 128) float32 RootSIFT.
        points_in_world: (N, 3).
    """

    words: NDArray[np.float32]
    points_in_world: NDArray[np.float64]


def sift(image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Pixels (N, 2) and RootSIFT (N, 128) of an image."""
    keypoints, words = cv2.SIFT.create(_CORNERS).detectAndCompute(image, None)
    if words is None:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    pixels = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    sums = np.abs(words).sum(axis=1, keepdims=True)
    return pixels, np.sqrt(words / np.maximum(sums, 1e-9)).astype(np.float32)


def matched(
    words: NDArray[np.float32], others: NDArray[np.float32], ratio: float
) -> NDArray[np.int64]:
    """(M, 2) rows whose nearest word is nearer than the next one by a ratio."""
    if len(words) == 0 or len(others) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    # RootSIFT is of length one: distances follow from products.
    squared = np.maximum(2 - 2 * words @ others.T, 0)
    two = np.argpartition(squared, 1, axis=1)[:, :2]
    values = np.take_along_axis(squared, two, axis=1)
    swapped = values[:, 0] > values[:, 1]
    two[swapped], values[swapped] = two[swapped][:, ::-1], values[swapped][:, ::-1]
    kept = np.flatnonzero(values[:, 0] < ratio**2 * values[:, 1])
    return np.column_stack([kept, two[kept, 0]])


def map_frame(world_from_cam: SE3, pair: StereoPair) -> MapFrame:
    """What SIFT and a disparity give for one place."""
    camera = pair.camera
    (left, words), (right, others) = sift(pair.left), sift(pair.right)
    pairs = matched(words, others, _STEREO_RATIO)
    disparity_px = left[pairs[:, 0], 0] - right[pairs[:, 1], 0]
    level = np.abs(left[pairs[:, 0], 1] - right[pairs[:, 1], 1]) < 1.5
    kept = level & (disparity_px > 1.0) & (disparity_px < 160)
    pixels, depth_m = left[pairs[kept, 0]], camera.focal_baseline / disparity_px[kept]
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = np.column_stack([rays, np.ones(len(rays))]) * depth_m[:, None]
    return MapFrame(words[pairs[kept, 0]], world_from_cam @ points)


@dataclass(frozen=True, slots=True)
class Answer:
    """Where one picture was placed.

    Attributes:
        inliers: of the pose; 0 without one.
        off_m, off_deg: from the truth; infinite without a pose.
    """

    inliers: int
    off_m: float = np.inf
    off_deg: float = np.inf

    @property
    def near(self) -> bool:
        """Within the widest of the benchmark's thresholds."""
        return self.off_m < _NEAR_M and self.off_deg < _NEAR_DEG


def placed(
    image: NDArray[np.uint8], frames: list[MapFrame], camera: StereoCamera, truth: SE3
) -> Answer:
    """One picture against some frames of the map."""
    pixels, words = sift(image)
    points, seen = [], []
    for frame in frames:
        pairs = matched(words, frame.words, _RATIO)
        points.append(frame.points_in_world[pairs[:, 1]])
        seen.append(pixels[pairs[:, 0]])
    in_world, in_image = np.concatenate(points), np.concatenate(seen)
    if len(in_world) < _LEAST_INLIERS:
        return Answer(0)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    cv2.setRNGSeed(1)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        in_world, in_image, matrix, None, iterationsCount=2000, reprojectionError=_PNP_PX,
        confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not found or len(inliers) < _LEAST_INLIERS:
        return Answer(0)
    in_world, in_image = in_world[inliers[:, 0]], in_image[inliers[:, 0]]
    turn, shift = cv2.solvePnPRefineLM(in_world, in_image, matrix, None, turn, shift)
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    cam_from_world = SE3(rotation, np.asarray(shift[:, 0], dtype=np.float64))
    off = cam_from_world @ truth
    angle_deg = np.degrees(np.linalg.norm(off.log()[3:]))
    return Answer(len(inliers), float(np.linalg.norm(off.translation)), float(angle_deg))


def answers(places: Places, frames: list[tuple[SE3, MapFrame]], visit: Visit) -> list[Answer]:
    """Every place of a visit against the map."""
    centres = np.array([pose.translation for pose, _ in frames])
    found = []
    for pose, pair in places.pairs(visit, _AHEAD_M, _ASIDE_M):
        away_m = np.linalg.norm(centres - pose.translation, axis=1)
        near = [frames[k][1] for k in np.argsort(away_m)[:_MAP_FRAMES]]
        found.append(placed(pair.left, near, pair.camera, pose))
    return found


def shares(near: NDArray[np.bool_], base: NDArray[np.bool_]) -> tuple[float, float]:
    """Difference of two shares over the same places, in points, and its bootstrapped deviation."""
    rng = np.random.default_rng(1)
    chosen = rng.integers(0, len(near), (2000, len(near)))
    drawn = near[chosen].mean(axis=1) - base[chosen].mean(axis=1)
    return 100 * float(near.mean() - base.mean()), 100 * float(drawn.std())


def figures(towns: list[int], every_m: float, only: list[str], world: World) -> Iterator[Figure]:
    """Shares of each condition, differences to overcast, and how far those are from the road's."""
    maps = {}
    for town in towns:
        places = Places(town, every_m=every_m, world=world)
        maps[town] = places, [(pose, map_frame(pose, pair)) for pose, pair in places.pairs(MAP)]

    def seen(visit: Visit) -> list[Answer]:
        return [one for places, frames in maps.values() for one in answers(places, frames, visit)]

    base = seen(OVERCAST)
    overcast = np.array([answer.near for answer in base])
    yield Figure("places", len(base))
    yield Figure("overcast: within 5 m, 10°", 100 * float(overcast.mean()), "%")
    yield Figure("overcast: inliers", float(np.median([answer.inliers for answer in base])))
    distances = []
    for against in CONDITIONS:
        if only and against.visit.name not in only:
            continue
        found = seen(against.visit)
        near = np.array([answer.near for answer in found])
        change, deviation = shares(near, overcast)
        distances.append(abs(change - against.road))
        name = against.visit.name
        yield Figure(f"{name}: difference to overcast (road {against.road:g})", change, "points")
        yield Figure(f"{name}: its deviation over places", deviation, "points")
        yield Figure(f"{name}: inliers", float(np.median([answer.inliers for answer in found])))
    yield Figure("mean of the distances to the road", float(np.mean(distances)), "points")
    yield Figure("largest of them", float(np.max(distances)), "points")


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(JUDGED))
    parser.add_argument("--every", type=float, default=1.5, metavar="M", help="between places")
    parser.add_argument("--only", type=partial(str.split, sep=","), default=[])
    parser.add_argument("--world", type=int, default=int(World.SIX))
    asked = parser.parse_args()
    rows = figures(asked.towns, asked.every, asked.only, World(asked.world))
    report(rows, asked.json, f"world {asked.world}, towns {asked.towns}")


if __name__ == "__main__":
    main()
