"""How hard the simulated town is; what its knobs were set by.

    python -m engram_lab.fits.world                     # rows (a) to (c), (e): 3 to 5 minutes
    python -m engram_lab.fits.world --laps /tmp/month   # and (d), (f): half an hour; resumable

Rows (a) to (c) look at two towns that the knobs were not set on, (e) at the clip KITTI 06 under
$ENGRAM_DATA. Rows (d) and (f) map a month of 40 laps of 0.15 km and localise held-out laps.

The matcher that judges is OpenCV's alone, so that a better one of ours does not move the world:
FAST corners spread by a grid, BRIEF, brute force with ratio and mutual test, PnP-RANSAC. The
difficulty was set once, before any evaluation, against facts from outside (`lab/reports/town.md`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.cli.screen import Bars
from engram.config import config_hash
from engram.errors import SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.measures import Drive, route_not_localised
from engram.monitor import QUIET, Monitor
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.opencv_contrib import xfeatures2d
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.configurations import UNLIMITED, Configuration
from engram_lab.studies.drives import DriveSet, campaign_logs, drives_of
from engram_lab.studies.lockstep import read_runs
from engram_lab.studies.running import Plan, RankingOptions, built_map, make_plan, run
from engram_lab.town.camera_model import CONSTANTS
from engram_lab.town.campaigns import WORLD_VERSION, Campaign, Size, by_day, campaign_named
from engram_lab.town.conditions import WEATHERS
from engram_lab.town.drive import ROBOTS, DrivingStyle
from engram_lab.town.rendering import LOOP_M, VISITS, Places, Visit
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import simulate
from engram_lab.town.textures import Style

_FAST_THRESHOLD = 8
_CELL_PX = (64, 48)
_PER_CELL = 14  # about 600 corners at 512×384
_STEREO_HAMMING = 45
_HAMMING = 50
_RATIO = 0.9
_REPROJECTION_PX = 2.0
_ITERATIONS = 300
_WINDOW = 5  # of the block search for sub-pixel disparity, half side, px

SUCCESS_INLIERS = 20
SUCCESS_ERROR_M = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceFrame:
    """What the reference makes of a pair.

    Attributes:
        pixels: (N, 2) float32, those with depth.
        descriptors: (N, 32) uint8.
        points_in_cam: (N, 3) float64, metres.
        camera_matrix: (3, 3).
    """

    corners: int
    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    points_in_cam: NDArray[np.float64]
    camera_matrix: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReferenceMatch:
    """Inliers of the pose, and the pose; None where there is none."""

    inliers: int
    live_from_map: SE3 | None

    def succeeds(self, true_live_from_map: SE3) -> bool:
        """20 inliers, and the camera within 0.25 m of where it is."""
        return self.right_inliers(true_live_from_map) >= SUCCESS_INLIERS

    def right_inliers(self, true_live_from_map: SE3) -> int:
        """The inliers, 0 where the pose is wrong."""
        if self.live_from_map is None:
            return 0
        error = self.live_from_map.inverse() @ true_live_from_map
        return self.inliers if error.distance_m < SUCCESS_ERROR_M else 0


def reference_frame(pair: StereoPair) -> ReferenceFrame:
    """Corners with depth."""
    camera = pair.camera
    left, left_descriptors = _describe(pair.left)
    right, right_descriptors = _describe(pair.right)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    pixels, kept, disparities = [], [], []
    for a, b in _stereo_matches(left, left_descriptors, right, right_descriptors):
        disparity = _refined_disparity(pair, left[a], right[b])
        if disparity is not None:
            pixels.append(left[a])
            kept.append(a)
            disparities.append(disparity)
    points = camera.triangulate(
        np.array(pixels, dtype=np.float32).reshape(-1, 2), np.array(disparities, dtype=np.float32)
    )
    return ReferenceFrame(
        len(left),
        np.array(pixels, dtype=np.float32).reshape(-1, 2),
        left_descriptors[kept],
        points.astype(np.float64),
        matrix,
    )


def reference_match(live: ReferenceFrame, node: ReferenceFrame) -> ReferenceMatch:
    """Matches a live frame to a map's: the node's points onto the live frame's pixels."""
    pairs = _mutual(node.descriptors, live.descriptors)
    if len(pairs) < 8:
        return ReferenceMatch(0, None)
    points = node.points_in_cam[pairs[:, 0]]
    pixels = live.pixels[pairs[:, 1]].astype(np.float64)
    cv2.setRNGSeed(1)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, pixels, live.camera_matrix, None, iterationsCount=_ITERATIONS,
        reprojectionError=_REPROJECTION_PX, confidence=0.999, flags=cv2.SOLVEPNP_P3P,
    )  # fmt: skip
    if not found or len(inliers) < 6:
        return ReferenceMatch(0, None)
    chosen = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(
        points[chosen], pixels[chosen], live.camera_matrix, None, rotation, translation
    )
    turned = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64)
    pose = SE3(turned, np.asarray(translation, dtype=np.float64)[:, 0])
    return ReferenceMatch(len(chosen), pose)


def _describe(image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    detector = cv2.FastFeatureDetector.create(_FAST_THRESHOLD)
    cells: dict[tuple[int, int], int] = {}
    chosen = []
    for corner in sorted(detector.detect(image, None), key=lambda k: -k.response):
        cell = (int(corner.pt[0]) // _CELL_PX[0], int(corner.pt[1]) // _CELL_PX[1])
        if cells.get(cell, 0) < _PER_CELL:
            cells[cell] = cells.get(cell, 0) + 1
            chosen.append(corner)
    brief = xfeatures2d("the reference matcher").BriefDescriptorExtractor.create(32, False)
    kept, descriptors = brief.compute(image, chosen)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
    pixels = np.array([corner.pt for corner in kept], dtype=np.float32).reshape(-1, 2)
    return pixels, np.asarray(descriptors, dtype=np.uint8)


def _distances(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
    words_a, words_b = a.view(np.uint64), b.view(np.uint64)
    return np.asarray(np.bitwise_count(words_a[:, None] ^ words_b[None]).sum(-1), dtype=np.int32)


def _stereo_matches(
    left: NDArray[np.float32], left_descriptors: NDArray[np.uint8],
    right: NDArray[np.float32], right_descriptors: NDArray[np.uint8],
) -> NDArray[np.int64]:  # fmt: skip
    if not len(left) or not len(right):
        return np.zeros((0, 2), dtype=np.int64)
    distance = _distances(left_descriptors, right_descriptors)
    shift = left[:, None] - right[None]
    distance[(np.abs(shift[..., 1]) > 1) | (shift[..., 0] < 0.5) | (shift[..., 0] > 160)] = 999
    best = distance.argmin(1)
    rows = np.arange(len(left))
    good = (distance[rows, best] < _STEREO_HAMMING) & (distance.argmin(0)[best] == rows)
    return np.stack([rows[good], best[good]], axis=1)


def _refined_disparity(
    pair: StereoPair, left: NDArray[np.float32], right: NDArray[np.float32]
) -> float | None:
    """Block search around the matched corner with a parabola through the best three."""
    x, y, x_right, w = int(left[0]), int(left[1]), int(right[0]), _WINDOW
    height, width = pair.left.shape
    if min(x, y, x_right - 2) < w or max(x, x_right + 2) >= width - w or y >= height - w:
        return None
    patch = pair.left[y - w : y + w + 1, x - w : x + w + 1].astype(np.float32)
    strip = pair.right[y - w : y + w + 1, x_right - w - 2 : x_right + w + 3].astype(np.float32)
    costs = [float(np.abs(patch - strip[:, s : s + 2 * w + 1]).sum()) for s in range(5)]
    best = int(np.argmin(costs))
    if best in {0, 4}:
        return None
    bend = costs[best - 1] - 2 * costs[best] + costs[best + 1]
    fraction = 0.5 * (costs[best - 1] - costs[best + 1]) / bend if bend > 1e-6 else 0.0
    disparity = x - (x_right + best - 2 + fraction)
    return disparity if disparity >= 0.8 else None


def _mutual(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int64]:
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    distance = _distances(a, b)
    rows = np.arange(len(a))
    best = distance.argmin(1)
    second = np.partition(distance, 1, axis=1)[:, 1]
    good = (
        (distance[rows, best] < _HAMMING)
        & (distance.argmin(0)[best] == rows)
        & (distance[rows, best] < _RATIO * second)
    )
    return np.stack([rows[good], best[good]], axis=1)


MAPPED = "morning"
# The towns that the knobs were set on, and two that were looked at only afterwards.
TUNED_TOWNS = (1, 2, 3)
UNSEEN_TOWNS = (4, 5)
# KITTI 06 from frame 0 to 50, with which row (e) compares: the mean way between two frames.
CLIP_FRAMES = 51
CLIP_SPACING_M = 1.197
CLIP_STEPS = (1, 2, 4, 6)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    letter: str
    what: str
    value: float
    low: float
    high: float
    unit: str

    def text(self) -> str:
        """A line for people."""
        bounds = f"{self.low:.3g} to {self.high:g}"
        return f"{self.letter}  {self.what:42} {self.value:8.2f} {self.unit:10} ({bounds})"


def world_hash() -> str:
    """Changes with the world's version, and with what sets its difficulty."""
    return config_hash(
        {
            "version": WORLD_VERSION,
            "style": Style(),
            "weathers": WEATHERS,
            "robots": ROBOTS,
            "driving": DrivingStyle(0),
            "camera": CONSTANTS,
        }
    )


Frames = list[tuple[SE3, ReferenceFrame]]


def reference_frames(
    places: Places, visit: Visit, ahead_m: float = 0.0, aside_m: float = 0.0
) -> Frames:
    """True pose and reference frame at each place."""
    return [(pose, reference_frame(pair)) for pose, pair in places.pairs(visit, ahead_m, aside_m)]


def inliers_of(node_frames: Frames, live_frames: Frames) -> NDArray[np.int64]:
    """(P,) inliers of each place of one visit matched against the same place of another.

    0 where the pose is wrong.
    """
    return np.array(
        [
            reference_match(live, node).right_inliers(world_from_live.inverse() @ world_from_node)
            for (world_from_node, node), (world_from_live, live) in zip(
                node_frames, live_frames, strict=True
            )
        ],
        dtype=np.int64,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """How well the morning's map localises the other visits of a town.

    Attributes:
        corners: (P,) corners of the morning's frames.
        inliers: by the name of a visit, (P,) each.
    """

    corners: NDArray[np.int64]
    inliers: Mapping[str, NDArray[np.int64]]

    @staticmethod
    def pooled(towns: Sequence[Appearance]) -> Appearance:
        """All places of some towns as those of one."""
        return Appearance(
            np.concatenate([town.corners for town in towns]),
            {
                name: np.concatenate([town.inliers[name] for town in towns])
                for name in towns[0].inliers
            },
        )


def appearance(
    places: Places, visits: Sequence[str] = tuple(VISITS), monitor: Monitor = QUIET
) -> Appearance:
    """Matches the morning at all places against every other visit.

    The map is made at the places, live stands half a metre from them: 0.35 m ahead and as much to
    the left.
    """
    morning = reference_frames(places, VISITS[MAPPED])
    inliers: dict[str, NDArray[np.int64]] = {}
    for name in visits:
        if name != MAPPED:
            inliers[name] = inliers_of(morning, reference_frames(places, VISITS[name], 0.35, 0.35))
        monitor.advance(name)
    return Appearance(np.array([frame.corners for _, frame in morning]), inliers)


def appearance_table(seen: Appearance) -> list[Row]:
    """Rows (a) to (c)."""
    same = float(seen.inliers["next morning"].mean())
    later = float(seen.inliers["an hour later"].mean())
    rows = [
        Row("a", "corners a frame", float(seen.corners.mean()), 450, 750, ""),
        Row("a", "same hour, next day", same, 100, np.inf, "inliers"),
        Row("b", "an hour later", 100 * later / max(same, 1), 60, 85, "% of (a)"),
    ]
    for other, high, low in (
        ("late afternoon", 20, 0),
        ("night", 10, 0),
        ("snow", 20, 0),
        ("overcast", 50, 20),
    ):
        share = 100 * float((seen.inliers[other] >= SUCCESS_INLIERS).mean())
        rows.append(Row("c", f"{MAPPED} map, {other}", share, low, high, "% succeed"))
    return rows


def falloff(
    pairs: Sequence[tuple[SE3, StereoPair]], steps: Sequence[int], every: int = 2
) -> dict[int, float]:
    """Mean inliers between a frame and the one some frames further on, along one drive."""
    frames = [(pose, reference_frame(pair)) for pose, pair in pairs]
    return {
        step: float(inliers_of(frames[: len(frames) - step : every], frames[step::every]).mean())
        for step in steps
    }


def falloff_table(town: Mapping[int, float], clip: Mapping[int, float]) -> list[Row]:
    """Rows (e): inliers in the town ÷ those on the clip, by the distance ahead."""
    return [
        Row("e", f"{step * CLIP_SPACING_M:.1f} m ahead", town[step] / count, 1 / 1.5, 1.5, "× clip")
        for step, count in clip.items()
    ]


LAPS = 40
# The laps whose five folds leave 20 to build from.
_EARLY_LAPS = 25
_EVERYTHING = Configuration("distance", UNLIMITED)
# Counts only, more of them than there are candidates, one after another: the first success ends it.
_EXHAUSTIVE = RobotOptions(ranking="distance", lanes=1, rounds=UNLIMITED, relocaliser="fabmap")
# Of `village`: a clear morning, where its road runs straight between houses, as on the clip.
_SESSION, _FIRST_FRAME = 1, 60


def looks(monitor: Monitor = QUIET) -> list[Row]:
    """Rows (a) to (c), and (e) where the clip is at hand."""
    seen = []
    for seed in UNSEEN_TOWNS:
        with monitor.stage(f"town {seed}", len(VISITS)) as part:
            seen.append(appearance(Places(seed), monitor=part))
    rows = appearance_table(Appearance.pooled(seen))
    clip = load_clip()
    if clip is not None:
        rows += falloff_table(falloff(town_like_clip(), CLIP_STEPS), falloff(clip, CLIP_STEPS))
    return rows


def load_clip() -> list[tuple[SE3, StereoPair]] | None:
    """KITTI 06, frames 0 to 50, with true poses; None where ``$ENGRAM_DATA`` has it not."""
    root = os.environ.get("ENGRAM_DATA")
    odometry = Path(root or "") / "kitti_odometry"
    clip, truth = odometry / "sequences" / "06", odometry / "poses" / "06.txt"
    if not root or not clip.is_dir() or not truth.is_file():
        return None
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(truth)]
    pairs = [pair for pair in open_drive(clip) if isinstance(pair, StereoPair)]
    return list(zip(poses, pairs, strict=False))[:CLIP_FRAMES]


def town_like_clip() -> list[tuple[SE3, StereoPair]]:
    """As many frames of the town by KITTI's camera, at the clip's spacing."""
    village = campaign_named("village")
    plan = replace(village.session(_SESSION), robot="kitti")
    sessions = (*village.sessions[:_SESSION], plan, *village.sessions[_SESSION + 1 :])
    drive = SimulatedDrive(replace(village, sessions=sessions, spacing_m=CLIP_SPACING_M), _SESSION)
    last = _FIRST_FRAME + CLIP_FRAMES
    poses = drive.world_from_cams()[_FIRST_FRAME:last]
    return list(zip(poses, drive.frames(_FIRST_FRAME, last), strict=True))


def month(seed: int = 1, laps: int = LAPS) -> Campaign:
    """`begbroke24h` in small: a loop of 0.15 km and some of its 140 laps.

    A systematic sample of the laps in the order of weather and hour, so that few laps meet all
    hours and every weather in its share: how many of them are rainy decides what fails.
    """
    whole = campaign_named("begbroke24h", seed, Size.FULL)
    ordered = sorted(whole.sessions, key=lambda lap: (lap.weather, lap.start.time(), lap.number))
    first = np.random.default_rng([seed, 0x40]).random()
    drawn = [ordered[int((k + first) * len(ordered) / laps)] for k in range(laps)]
    drawn.sort(key=lambda lap: lap.number)
    sessions = tuple(replace(lap, number=number) for number, lap in enumerate(drawn))
    return replace(whole, name="month", home="month", length_m=LOOP_M, sessions=sessions)


@dataclass(frozen=True, slots=True)
class MonthResult:
    """What a cross-validation over the laps came to, 0…1 each.

    Attributes:
        saved: share of the training laps' frames that did not localise: the distance that is
            saved as new experience.
        can_succeed: share of these that match it.
        fails_by_day: share of the route of held-out laps between 7 and 19 h without a match.
    """

    saved: float
    candidates: float
    can_succeed: float
    fails_by_day: float
    fails: float


def measure_laps(
    laps: Sequence[Path], work: Path, workers: int = 1, monitor: Monitor = QUIET
) -> MonthResult:
    """Five folds over some laps, everything attempted; continues where an earlier run stopped."""
    missing = [path for path in laps if not path.exists()]
    if missing:
        raise SequenceError(f"{len(missing)} laps are not rendered; the first is {missing[0]}")
    options = RankingOptions(
        ("distance",), (UNLIMITED,), (1,), map_sizes=False, live_folds=0, build=_EXHAUSTIVE
    )
    drives = DriveSet(f"month-{len(laps)}", drives_of(laps))
    plan = make_plan(drives, Settings(), options, work)
    run(plan, workers, monitor)
    return _result(plan)


def _result(plan: Plan) -> MonthResult:
    localised = [
        one.share_localised for fold in plan.folds for one in built_map(plan, fold).sessions
    ]
    held_out: list[Drive] = []
    of_day: list[Drive] = []
    candidates, succeeded = [], []
    for number, lap in enumerate(plan.drives.drives):
        runs = read_runs(plan.runs_path(number, "memo"))
        if runs is None:
            raise SequenceError(f"{lap.path}: was not localised; run the same again")
        row = runs.configurations.index(_EVERYTHING)
        held_out.append(Drive(runs.step_m, runs.matched[row]))
        if by_day(datetime.fromtimestamp(lap.session.start_ns / 1e9, UTC)):
            of_day.append(held_out[-1])
        candidates.append(runs.candidates[row])
        succeeded.append(runs.succeeded[row])
    tried = np.concatenate(candidates)
    return MonthResult(
        saved=1 - float(np.mean(localised)),
        candidates=float(tried.mean()),
        can_succeed=float(np.concatenate(succeeded).sum() / max(tried.sum(), 1)),
        fails_by_day=route_not_localised(of_day),
        fails=route_not_localised(held_out),
    )


def laps_table(folder: Path, seed: int, workers: int, monitor: Monitor) -> list[Row]:
    """Rows (d) and (f); renders the laps that are not there yet."""
    campaign = month(seed)
    simulate(campaign, folder, workers=workers, monitor=monitor)
    laps = campaign_logs(campaign, folder)
    whole = measure_laps(laps, folder, workers, monitor)
    early = measure_laps(laps[:_EARLY_LAPS], folder, workers, monitor)
    return [
        Row("d", f"saved of {len(laps)} laps, four fifths mapped", 100 * whole.saved, 15, 30, "%"),
        Row("d", "candidates within 8 m after 20 laps", early.candidates, 40, np.inf, ""),
        Row("d", "of which can succeed", 100 * early.can_succeed, 0, 15, "%"),
        Row("f", "route failed, everything tried, by day", 100 * whole.fails_by_day, 3, 8, "%"),
        Row("f", "route failed, around the clock", 100 * whole.fails, 5, 15, "%"),
    ]


def main() -> None:
    """Reads the command line."""
    parser = command_line(__doc__)
    parser.add_argument("--laps", type=Path, metavar="DIR", help="also (d), (f); laps kept here")
    parser.add_argument("--seed", type=int, default=1, help="of the town of the laps")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    asked = parser.parse_args()
    rows = looks(Bars())
    if asked.laps is not None:
        rows += laps_table(asked.laps, asked.seed, asked.workers, Bars())
    print("\n".join(row.text() for row in rows))
    figures = [Figure(f"{row.letter}: {row.what}", row.value, row.unit) for row in rows]
    report(figures, asked.json, f"world {world_hash()}")


if __name__ == "__main__":
    main()
