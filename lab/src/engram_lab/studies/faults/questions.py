"""Questions of one kind: robots drive in maps of towns, something happens, fixes are counted.

`engram lab evaluate faults --only NAME` asks one. Each is a function of `QUESTIONS`: what it does
stands in its docstring. All count alike (`engram_lab.accuracy.Count`).
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from engram.frontend.frame import FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId, node_id
from engram.localiser.acceptance import AcceptanceConfig, Rule
from engram.localiser.attempts import Lanes
from engram.localiser.localisation import Budget, Localisation, Position
from engram.odometry.motion import GapFiller
from engram.odometry.odometry import Odometry
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.front import Front
from engram.sequences.sequence import LoggedFrame
from engram_lab.accuracy import LEVELS, Count, squared, way_m
from engram_lab.programs import Figure
from engram_lab.studies.drives import split
from engram_lab.studies.faults import fleets, standing
from engram_lab.studies.faults.clips import Clip
from engram_lab.studies.faults.injected import Frozen, Shown, undisturbed
from engram_lab.studies.faults.staging import Scene, mapped_by
from engram_lab.studies.faults.study import RealPlan, localised
from engram_lab.studies.faults.table import Asked, Table, figures_of
from engram_lab.studies.streets import (
    Kind,
    Street,
    Try,
    WrongPlaces,
    all_streets,
    campaign_of,
    drives_in,
    light_of,
    street,
    streets,
    town_pairs,
)
from engram_lab.town.campaigns import AGAIN, BESIDE, MAPPED, estate
from engram_lab.town.streets import Fronts
from engram_lab.wheels import BIAS_RAD_S, Wheels, measured

_LOST_ROUNDS = Budget().lost_rounds
# A pose that is known well, and motion of a robot at rest.
_STILL = OdometryStep(OdometryStatus.OK, SE3.identity(), 1e-6 * np.eye(6), 200)


def misplaced(asked: Asked, *kinds: Kind) -> Iterator[Figure]:
    """Robots on the streets of some towns, as many of each kind; the 40 frames after it count."""
    table, found = (
        Table("misplaced", asked),
        list(streets(asked.towns, asked.settings, _LOST_ROUNDS)),
    )
    each = -(-(asked.trials or 3000) // (len(found) * len(kinds)))
    for name, there in found:
        for kind in kinds:
            for one in there.tries(kind, each, seed=1):
                table.add(kind.value, f"{name}, {one}", partial(there.count, one))
        there.close()
    return table.figures()


def hints(asked: Asked) -> Iterator[Figure]:
    """Robots that are given a place 15 m or more off (σ 0.1, 1 or 3 m), or carried there unseen."""
    return misplaced(asked, Kind.MISPLACED, Kind.CARRIED)


def lost(asked: Asked) -> Iterator[Figure]:
    """Robots that are lost, or drive on past a gap of 5 to 29 frames without odometry."""
    return misplaced(asked, Kind.LOST, Kind.GAP)


def roads(asked: Asked) -> Iterator[Figure]:
    """Undisturbed robots on a campaign, told their place or started lost: events per 100 km.

    Of `keble`, or CAMPAIGN, `--trials` maps (8) of three drives each are drawn, or one is built
    from `--mapped`. Every other drive, or `--live`, is driven there to its end: once from its
    first frame, once from a frame drawn at random, lost.
    """
    campaign, table = campaign_of(asked.campaign or "keble"), Table("undisturbed", asked)
    every = range(len(campaign.sessions))
    needed = {*asked.mapped, *asked.live} if asked.live else set(every)
    drives = drives_in(campaign, asked.settings, sorted(needed))
    maps = [asked.mapped] if asked.mapped else drawn_maps(len(every), asked.trials or 8)
    for mapped in maps:
        for number in (one for one in asked.live or every if one not in mapped):
            live = drives[number]
            rng = np.random.default_rng(live.session.start_ns)
            for kind in (Kind.UNDISTURBED, Kind.COLD):

                def driven() -> Count:
                    there = street(campaign, mapped, drives, live, asked.settings)  # noqa: B023
                    first = int(rng.integers(len(there.frames) // 2))  # noqa: B023
                    one = Try(kind, first if kind is Kind.COLD else 0)  # noqa: B023
                    with closing(there):
                        return there.count(one)

                table.add(kind.value, f"{campaign.home} {mapped} {live.name}", driven)
    return table.figures()


def drawn_maps(drives: int, maps: int, mapped: int = 3, seed: int = 0) -> list[tuple[int, ...]]:
    """Which drives each map is built from, in the order of time; one drawn twice counts once."""
    rng = np.random.default_rng(seed)
    drawn = (rng.choice(drives, mapped, replace=False).tolist() for _ in range(maps))
    return list(dict.fromkeys(tuple(sorted(one)) for one in drawn))


def right_fixes(asked: Asked) -> Iterator[Figure]:
    """Right fixes by `confidence` and by the published rule of inliers, by weather.

    Every drive of a small town is localised in each map that it is no part of, from a true start.
    Lost is what the rule of inliers found rightly and `confidence` did not, less the opposite.
    """
    table, lost_points = Table("right-fixes", asked), []
    for plan, name, there in all_streets(asked.towns, asked.settings):
        right = {}
        for rule in Rule:
            acceptance = replace(asked.settings.localiser.acceptance, rule=rule)
            localiser = replace(asked.settings.localiser, acceptance=acceptance)
            there.settings = replace(asked.settings, localiser=localiser)
            undisturbed_robot = partial(there.count, Try(Kind.UNDISTURBED))
            right[rule] = table.add(f"{light_of(plan)}, {rule}", name, undisturbed_robot).right
        lost_points.append(100 * (right[Rule.INLIERS] - right[Rule.CONFIDENCE]) / len(there.frames))
        there.close()
    yield from table.figures()
    yield Figure("lost by `confidence`, mean of the drives", float(np.mean(lost_points)), "points")
    yield Figure("  most of one drive", max(lost_points), "points")


def wheels(asked: Asked) -> Iterator[Figure]:
    """Drives without wheels and with them, right and wrong in six ways, by weather."""
    table = Table("wheels", asked)
    for plan, name, there in all_streets(asked.towns, asked.settings):
        stamps = [one.frame.stamp_ns for one in there.frames]
        for kind in (None, *Wheels):
            outside = None if kind is None else measured(there.truth, stamps, 1, kind)
            row = f"{light_of(plan)}, {'no wheels' if kind is None else kind.value}"
            robot = partial(there.count, Try(Kind.UNDISTURBED), outside=outside)
            table.add(row, name, robot)
        there.close()
    return table.figures()


_BLACK_M, _SETTLED_M, _APART_M, _REST = 50.0, 20.0, 15.0, 20


def blackouts(asked: Asked) -> Iterator[Figure]:
    """Robots whose cameras are black for 50 m, five seconds at 10 m/s, with and without wheels.

    Wheels measure 2 % too much and scatter by 1 %; the gyroscope has a bias of 0.01 rad/s, noise of
    0.002 rad/s, and two seconds of rest at the start. Nothing searches for a lost robot: it is
    found by dead reckoning. Frames until found count from the first bright one.
    """
    table = Table("blackouts", asked)
    for name, there in streets(asked.towns, asked.settings, _LOST_ROUNDS):
        steps = [
            (a.inverse() @ b).distance_m for a, b in zip(there.truth, there.truth[1:], strict=False)
        ]
        along_m = np.concatenate([[0.0], np.cumsum(steps)])
        starts = np.arange(_SETTLED_M, along_m[-1] - _BLACK_M - 10, _APART_M)[: asked.trials or 20]
        for start, aided in product(starts.tolist(), (True, False)):
            first = int(np.searchsorted(along_m, start))
            last = int(np.searchsorted(along_m, along_m[first] + _BLACK_M)) - 1
            row = "wheels and gyroscope" if aided else "cameras alone"
            robot = partial(_in_the_dark, there, first, last, aided)
            table.add(row, f"{name} from frame {first}", robot)
        there.close()
    return table.figures()


def _in_the_dark(there: Street, first: int, last: int, aided: bool) -> Count:
    stamps = [one.frame.stamp_ns for one in there.frames]
    outside = measured(there.truth, stamps, seed=first)
    rest, found = OutsideMotion(SE3.identity(), 0.1, True, BIAS_RAD_S), []
    with there.robot(relocalises=False) as robot:
        start = there.nodes.start(there.truth[0])
        assert start is not None
        robot.place_at(start)
        for number in range(_REST, 0, -1):  # the first frame again and again, before the start
            frame = replace(there.frames[0].frame, stamp_ns=stamps[0] - number * 10**8)
            step = there.frames[0].odometry if number == _REST else _STILL
            robot.step(LoggedFrame(frame, step), motion=rest if aided and number < _REST else None)
        for number, logged in enumerate(there.frames[: last + 62]):
            frame, step = logged.frame, logged.odometry if number else _STILL
            if first <= number <= last:
                frame = replace(frame, status=FrameStatus.DARK)
                step = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
            elif number == last + 1:
                step = OdometryStep(OdometryStatus.NO_CONSENSUS)
            motion = (outside[number] or rest) if aided else None
            found.append((number, robot.step(LoggedFrame(frame, step), motion=motion)))
    return there.counted(found, after=last + 1)


def stalls(asked: Asked) -> Iterator[Figure]:
    """A camera that stalls or freezes on KITTI 06, in maps of the whole drive and of parts.

    Stalls last 0.8 to 3.2 s at 10 Hz; `--trials` above 100 tries all gaps up to 4 s.
    """
    clip, fine = kitti_clip(), (asked.trials or 0) > 100
    starts = (range(4, 44, 4), range(1, 41)) if fine else (range(4, 40, 6), range(8, 33, 3))
    gaps = [(a, a + gap) for a, gap in product(*starts) if a + gap < len(clip) - 4]
    for name, frames in (
        ("whole", slice(None)), ("every other frame", slice(0, None, 2)), ("first half", slice(25))
    ):  # fmt: skip
        with TemporaryDirectory(prefix="engram-stalls-") as folder:
            path = Path(folder) / "map.engram"
            yield from figures_of(
                f"stalls, {name}", disturbed(clip, frames, path, stalled(clip, gaps))
            )
            path = Path(folder) / "again.engram"
            frozen = frozen_streams(clip, (10, 20, 30))
            yield from figures_of(f"freezes, {name}", disturbed(clip, frames, path, frozen))


def kitti_clip() -> Clip:
    """KITTI 06 of ENGRAM_DATA with its truth."""
    data = os.environ.get("ENGRAM_DATA")
    if not data:
        raise SystemExit("set ENGRAM_DATA to the folder of the real images")
    return RealPlan("kitti-06", "whole", Path(data)).read()


Disturbed = tuple[list[Shown], int]


def stalled(clip: Clip, gaps: Sequence[tuple[int, int]]) -> Iterator[Disturbed]:
    """The drive without the frames between two: what is shown, and the first frame after it."""
    whole = undisturbed(clip.pairs)
    return (([*whole[: last + 1], *whole[again:]], again) for last, again in gaps)


def frozen_streams(clip: Clip, starts: Sequence[int], length: int = 10) -> Iterator[Disturbed]:
    """Both cameras, or one of them, repeat an image under new stamps."""
    rng = np.random.default_rng(0)
    for start, sides in product(starts, (("left", "right"), ("left",), ("right",))):
        yield Frozen(sides).apply(clip.pairs, length, start, rng), start + length


def disturbed(clip: Clip, mapped: slice, path: Path, shown: Iterator[Disturbed]) -> Count:
    """Robots that are shown a disturbed clip in a map of some of its frames, made at `path`."""
    part = Clip(clip.plan, clip.pairs[mapped], clip.world_from_cam[mapped])
    place, total = mapped_by(part, path), Count()
    with closing(place.opened):
        for frames, after in shown:
            scene = Scene(clip, place, 0, 0.0, frames)
            at = next(k for k, one in enumerate(frames) if one.frame >= after)
            poses = [clip.world_from_cam[one.frame] for one in frames]
            total += Count.of(localised(scene)[0], poses, at)
    return total


_WITHIN_M, _FINDABLE_INLIERS, _WRONG_M = 10.0, 40, 5.0
# A match is accepted this far from its node, and right up to `_WRONG_M` off.
_REACH_M = AcceptanceConfig().reach_m


def cold_starts(asked: Asked) -> Iterator[Figure]:
    """Robots switched on anywhere in a large map: how many are found within 10 m.

    Four folds of `village`, or CAMPAIGN, are mapped. On each drive of the fifth, or `--live`,
    `--trials` robots (640) are switched on, evenly spread. Where one is not found, all nodes that
    truly stand near are matched with every frame of those 10 m: could it have been found?
    """
    campaign, table = campaign_of(asked.campaign or "village"), Table("cold-starts", asked)
    drives = drives_in(campaign, asked.settings)
    fold = split(len(drives), 5)[0]
    starts = found = wrong = possible = 0
    for number in asked.live or fold.held_out:
        there = street(campaign, fold.training, drives, drives[number], asked.settings)
        for first in first_frames(there, asked.trials or 640):
            key = f"{campaign.home}@{campaign.seed} {there.live.name} {first}"
            one = table.add("switched on", key, partial(switched_on, there, first))
            starts, wrong = starts + 1, wrong + (one.worst_m > _WRONG_M)
            if one.fixes:
                found += one.worst_m <= _WRONG_M
                continue
            missed = partial(could_be_found, there, first, one.frames)
            possible += table.add("not found, but a node near matches", key, missed).robots
        there.close()
    yield from table.figures()
    yield Figure("cold starts", starts)
    yield Figure("  found within 10 m, of those that can be", 100 * found / (found + possible), "%")
    yield Figure("  wrong place accepted (> 5 m)", 100 * wrong / starts, "%")


def first_frames(there: Street, count: int) -> list[int]:
    """So many, evenly spread, each with 10 m to drive after it; all if there are fewer."""
    steps = [one.odometry.prev_from_curr for one in there.frames]
    lengths = [0.0 if step is None else step.distance_m for step in steps]
    able = np.flatnonzero(np.cumsum(lengths[::-1])[::-1] >= _WITHIN_M)
    rows = np.linspace(0, len(able) - 1, min(count, len(able))).round().astype(int)
    return [int(at) for at in able[rows]]


def switched_on(there: Street, first: int) -> Count:
    """A robot that starts lost at a frame, until its first fix or for 10 m."""
    found: list[tuple[int, Localisation]] = []
    for looked in there.run(Try(Kind.COLD, first)):
        found.append((looked.frame, looked.found))
        if looked.found.localised or way_m(there.truth[first : looked.frame + 1]) >= _WITHIN_M:
            break
    return there.counted(found)


def could_be_found(there: Street, first: int, frames: int) -> Count:
    """One robot if matching with the nodes near finds one of the frames; none if not."""
    matcher = Lanes(there.opened.frames, there.settings.localiser.matcher)
    for at in range(first, first + frames):
        live = there.frames[at].frame
        live_id = node_id(there.live.session.id, live.stamp_ns)
        near = there.nodes.near(there.truth[at], _REACH_M + _WRONG_M)
        for node in sorted(near) if live.status is FrameStatus.OK else ():
            match = matcher.match(live, live_id, node, None)
            pose = match.reference_from_live
            if pose is None or match.inliers < _FINDABLE_INLIERS or pose.distance_m > _REACH_M:
                continue
            error = there.error(at, node, pose)
            if error is not None and error[0] <= _WRONG_M:
                return Count(robots=1)
    return Count()


_FIRST_ESTATE, _PERIODS_M = 501, (20.0, 30.0, 37.5)


def equal_fronts(asked: Asked) -> Iterator[Figure]:
    """Estates whose fronts repeat every 20, 30 and 37.5 m: robots next to the mapped street.

    One ring of each town is mapped (501 to 503, or from the first of `--towns` on). Robots drive
    along the ring next to it, `--live` of 2, 3, 5, 6, from `--trials` places (2): switched on
    there, or told that they are on the mapped one. Every fix is false. Then the ring alone and both
    rings are mapped, and wrong edges counted. Last, a later drive is localised on the mapped ring.
    """
    first = asked.towns[0] if asked.towns[0] >= _FIRST_ESTATE else _FIRST_ESTATE
    table, beside = Table("equal-fronts", asked), asked.live or tuple(BESIDE)
    for seed, period_m in enumerate(_PERIODS_M, first):
        town = estate(seed, fronts=Fronts(period_m))
        drives = drives_in(town, asked.settings, [MAPPED, AGAIN, *beside])
        here = partial(street, town, drives=drives, settings=asked.settings, lost_rounds=8)
        for kind, number in product((Kind.COLD, Kind.UNDISTURBED), beside):
            with closing(here(mapped=[MAPPED], live=drives[number])) as there:
                starts = np.linspace(0, len(there.frames), asked.trials or 2, endpoint=False)
                for start in starts.astype(int).tolist():
                    robot = partial(there.count, Try(kind, start))
                    table.add(f"{kind} on the unmapped street", f"{seed} {number} {start}", robot)
        for mapped in ([MAPPED], [MAPPED, *beside]):
            with closing(here(mapped=mapped, live=drives[AGAIN])) as there:
                name = f"{seed}, {len(mapped)} drives mapped"
                yield from fleets.edge_figures(name, there.opened, there.nodes.pose)
                if mapped == [MAPPED]:
                    robot = partial(there.count, Try(Kind.UNDISTURBED))
                    table.add("later, on the mapped street", str(seed), robot)
    yield from table.figures()


def wrong_places(asked: Asked) -> Iterator[Figure]:
    """Attempts of lost robots at places where they are not: how many would be accepted.

    Each tenth frame of each drive, or each `--trials`-th, is matched with every node of each map:
    all of another town's, and those 15 m or more away in its own.
    """
    every = asked.trials or 10
    tried = {True: [0, 0, 0, 0], False: [0, 0, 0, 0]}
    most = {True: -100.0, False: -100.0}
    for _, there in town_pairs(asked.towns, asked.settings):
        places = WrongPlaces(there, every)
        found, same = [one for _, one in places.lost()], there.same_town
        counts = (
            places.attempts,
            sum(one.match.inliers >= 20 for one in found),
            sum(one.accepted for one in found),
            sum(one.plausible and not one.accepted for one in found),
        )
        tried[same] = [a + b for a, b in zip(tried[same], counts, strict=True)]
        most[same] = max([most[same], *(one.confidence for one in found)])
        there.close()
    for name, same in (("same town, 15 m away or more", True), ("another town", False)):
        what = ("attempts", "false, 20 inliers or more", "accepted", "waiting for a second")
        for part, value in zip(what, tried[same], strict=True):
            yield Figure(f"{name}: {part}", value)
        yield Figure(f"{name}: most log-odds", most[same])


_HEALTHY, _FOCAL, _BASELINE = "as it is", "focal length", "baseline"
_CODES = {_FOCAL: "focal_length_off", _BASELINE: "baseline_off"}


def calibration(asked: Asked) -> Iterator[Figure]:
    """Whether a wrong focal length or baseline shows when a robot localises in a map.

    Every drive of a small town is localised in each map that it is no part of, from a true start:
    as it is, and with each fault, 8 to 30 % too long or too short, in the robot's calibration
    alone. Counted are warnings of the doctor, and what the map measures.
    """
    rows: dict[str, list[tuple[float, float | None, bool, Count]]] = {}
    for plan, name, there in all_streets(asked.towns, asked.settings):
        for fault in (_HEALTHY, _FOCAL, _BASELINE):
            rng = np.random.default_rng(zlib.crc32(f"{name} {fault}".encode()))
            share = float(np.exp(rng.uniform(np.log(0.08), np.log(0.3))))
            by = 1.0 if fault == _HEALTHY else float((1 + share) ** rng.choice([-1, 1]))
            one = (by, *miscalibrated(there, fault, by))
            for row in (fault, f"{fault}, {light_of(plan)}"):
                rows.setdefault(row, []).append(one)
        there.close()
    for name, found in rows.items():
        yield Figure(f"{name}: warned of {len(found)}", sum(alarm for _, _, alarm, _ in found))
        yield Figure("  cannot tell", sum(told is None for _, told, _, _ in found))
        errors = [abs(told / by - 1) for by, told, _, _ in found if told is not None]
        if errors:
            yield Figure("  error of the factor, median", 100 * float(np.median(errors)), "%")
        yield from figures_of(name, sum((one for *_, one in found), Count()))


def miscalibrated(there: Street, fault: str, by: float) -> tuple[float | None, bool, Count]:
    """Factor by the map, whether the doctor warns, and the fixes of the examined frames."""
    settings = there.settings
    camera: StereoCamera = there.frames[0].frame.camera
    if fault == _FOCAL:
        camera = replace(camera, fx=camera.fx * by, fy=camera.fy * by)
    elif fault == _BASELINE:
        camera = replace(camera, baseline_m=camera.baseline_m * by)
    odometry, found, front = Odometry(settings.odometry), [], Front(settings)
    with there.robot(camera=camera, front=front) as robot:
        start = there.nodes.start(there.truth[0])
        if start is not None:
            robot.place_at(start)
        for number, one in enumerate(there.frames[: settings.doctor.frames]):
            frame = replace(one.frame, camera=camera)
            found.append((number, robot.step(LoggedFrame(frame, odometry.step(frame)))))
        codes = {one.code for one in robot.diagnosis.findings}
        rematched = front.examination.evidence.rematched
    told = rematched.baseline_factor if fault == _BASELINE else rematched.focal_factor
    wanted = {_CODES[fault]} if fault in _CODES else set(_CODES.values())
    return told, bool(codes & wanted), there.counted(found)


@dataclass(slots=True)
class _Coverage:
    """Squared normalised errors in one weather: of fixes, odometry, 20 m of dead reckoning.

    `sharp` and `wrong_sharp`: steps that claim less than 0.1 m, and those of them 0.2 m off.
    """

    fixes: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    reckoned: list[float] = field(default_factory=list)
    sharp: int = 0
    wrong_sharp: int = 0


_WRONG_STEP_M, _SHARP_M, _RECKONED_M, _EVERY = 0.2, 0.1, 20.0, 5


def covariances(asked: Asked) -> Iterator[Figure]:
    """Share of errors within the ellipsoids that should hold 50, 90 and 99 %, by weather.

    Of right fixes of undisturbed robots in every map of a town, of steps of odometry, and of 20 m
    of dead reckoning, in all six degrees of freedom.
    """
    found: dict[str, _Coverage] = {}
    driven: set[NodeId | object] = set()
    for plan, _, there in all_streets(asked.towns, asked.settings):
        one = found.setdefault(light_of(plan), _Coverage())
        if there.live.session.id not in driven:
            driven.add(there.live.session.id)
            _add_motion(one, there)
        for looked in there.run(Try(Kind.UNDISTURBED)):
            fix, at = there.fix(0, looked.frame, looked.found), looked.found
            if fix is None or fix.false or at.covariance is None:
                continue
            assert at.node is not None
            assert at.node_from_live is not None
            world_from_node = there.nodes.pose(at.node)
            assert world_from_node is not None
            true = world_from_node.inverse() @ there.truth[looked.frame]
            one.fixes.append(squared(at.node_from_live, at.covariance, true))
        there.close()
    for weather, one in sorted(found.items()):
        kinds = {"fixes": one.fixes, "steps of odometry": one.steps}
        kinds["20 m of dead reckoning"] = one.reckoned
        for name, values in kinds.items():
            yield Figure(f"{weather}: {name}", len(values))
            for level in LEVELS if values else ():
                inside = np.array(values) <= chi2.ppf(level, 6)
                yield Figure(f"  within {100 * level:.0f} %", 100 * float(inside.mean()), "%")
        yield Figure(f"{weather}: sharp steps", one.sharp)
        yield Figure("  wrong ones among them", one.wrong_sharp)


def _add_motion(one: _Coverage, there: Street) -> None:
    """Measured steps of a drive, and stretches of dead reckoning from every fifth frame on."""
    gaps, truth = GapFiller(), there.truth
    last: int | None = None
    open_: list[tuple[int, Position]] = []
    nowhere = node_id(there.live.session.id, 0)
    for number, logged in enumerate(there.frames):
        landmarks = len(logged.frame.landmarks)
        motion = gaps.motion(logged.odometry, logged.frame.stamp_ns, landmarks=landmarks)
        if not motion.usable:
            continue
        step, covariance = motion.prev_from_curr, motion.covariance
        if step is not None and covariance is not None and last is not None:
            true = truth[last].inverse() @ truth[number]
            if not motion.guessed_m:
                sharp = _sigma_m(covariance) < _SHARP_M
                one.sharp += sharp
                one.wrong_sharp += sharp and (step.inverse() @ true).distance_m > _WRONG_STEP_M
                one.steps.append(squared(step, covariance, true))
            open_ = [(start, at.carried_on(step, covariance)) for start, at in open_]
        elif last is not None:
            open_ = []
        for start, at in list(open_):
            true = truth[start].inverse() @ truth[number]
            if true.distance_m >= _RECKONED_M:
                one.reckoned.append(squared(at.node_from_live, at.covariance, true))
                open_.remove((start, at))
        if number % _EVERY == 0:
            open_.append((number, Position(nowhere, SE3.identity(), np.zeros((6, 6)))))
        last = number


def _sigma_m(covariance: NDArray[np.float64]) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))


QUESTIONS: dict[str, Callable[[Asked], Iterator[Figure]]] = {
    "hints": hints,
    "lost": lost,
    "undisturbed": roads,
    "right-fixes": right_fixes,
    "wheels": wheels,
    "blackouts": blackouts,
    "stalls": stalls,
    "cold-starts": cold_starts,
    "equal-fronts": equal_fronts,
    "wrong-places": wrong_places,
    "calibration": calibration,
    "covariances": covariances,
    "standing": standing.standing,
    "edges": fleets.edges,
    "saving": fleets.saving,
    "goals": fleets.goals,
    "memories": fleets.memories,
    "directions": fleets.directions,
    "mountings": fleets.mountings,
    "lenses": fleets.lenses,
    "dreams": fleets.dreams,
}
