"""Drives with injected faults, localised in a map of the same place: what is claimed, and is true.

A trial is a fault, a clip, a start and a strength. The map is made from the clip's own town on
another day; then the drive is mapped into a copy of it. Trials are numbered; each is drawn from its
number, so that a run is resumed by number.

Real drives as clips, where ENGRAM_DATA names them: one part is mapped, another driven there. Each
is driven there and back, or back and there, so that it is as long as a rendered clip. Cameras keep
looking the same way.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np

from engram.errors import SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.graph.model import EdgeKind
from engram.localiser.localisation import Localisation
from engram.maps.map import open_map
from engram.monitor import QUIET, Monitor
from engram.robot.mapping import Beginning, map_drive
from engram.robot.robot import LastFrame
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.motion_files import Trajectory, read_kitti_poses
from engram.sequences.opening import open_drive
from engram_lab.accuracy import Fix, events, way_m
from engram_lab.studies.building import edge_errors
from engram_lab.studies.faults.clips import JUDGING, REVERSED, Clip, ClipDrive, Plan
from engram_lab.studies.faults.injected import undisturbed
from engram_lab.studies.faults.staging import (
    ELSEWHERE,
    KINDS,
    MADE_BY,
    STRENGTHS,
    Places,
    Scene,
    Trial,
    TrialFile,
    drawn,
    fault_of,
    staged,
)
from engram_lab.truth import read_matrix_truth


def map_on(trial: Trial, scene: Scene, path: Path) -> None:
    """Maps the scene into a copy of its map, and fills in what that did to it."""
    shutil.copyfile(scene.place.path, path)
    drive = ClipDrive(scene.clip.plan, [one.pair for one in scene.shown])
    begin = partial(_told, scene)
    report = map_drive(path, drive, Settings(), RobotOptions(force=True), begin=begin)
    assert report.diagnosis is not None
    trial.map_refused = [one.code for one in report.diagnosis.fatal]
    if drive.skipped:
        trial.map_refused.append("stamps that do not rise")
    true = {one.pair.stamp_ns: scene.clip.world_from_cam[one.frame] for one in scene.shown}
    with open_map(path) as opened:
        graph = opened.graph
        live = {
            one.id: true[one.stamp_ns] for one in graph.nodes if one.session == report.session.id
        }
        laid = [edge for edge in graph.edges if edge.a in live or edge.b in live]
    world_from_node = {**scene.place.world_from_node, **live}
    trial.nodes, trial.edges = len(live), len(laid)
    wrong = [one for one in edge_errors(laid, world_from_node.get) if one.joins_places]
    trial.joined_odometry = sum(one.kind is EdgeKind.ODOMETRY for one in wrong)
    trial.joined = len(wrong) - trial.joined_odometry
    trial.worst_edge_m = max((one.error_m for one in wrong), default=0.0)


def _told(scene: Scene, beginning: Beginning) -> None:
    """Gives the robot a wrong place before the first frame of the fault."""
    if scene.hint is None:
        return
    hint, before_ns = scene.hint, scene.clip.pairs[scene.start - 1].stamp_ns

    def tell(seen: LastFrame, found: Localisation) -> None:
        del found
        if seen.frame.stamp_ns == before_ns:
            beginning.robot.place_at(hint)

    beginning.robot.watch = tell


@dataclass(frozen=True, slots=True)
class RealDrive:
    """A real drive with truth.

    Attributes:
        read_truth: reads that file; gets the stamps of the frames, ns.
    """

    rig: str
    folder: str
    truth_file: str
    read_truth: Callable[[Path, Sequence[int]], Trajectory]
    mapped: slice
    live: slice


DRIVES = {
    "kitti-06": RealDrive(
        "kitti",
        "kitti_odometry/sequences/06",
        "kitti_odometry/poses/06.txt",
        read_kitti_poses,
        slice(0, None, 2),
        slice(1, None, 2),
    ),
    "v1-01": RealDrive(  # of 63 frames, within 110 s, in the same room again and again
        "euroc",
        "euroc/V1_01_easy_sparse",
        "euroc/V1_01_easy_sparse/poses_world_from_rectified_cam0.txt",
        lambda path, _: read_matrix_truth(path),
        slice(0, 31),
        slice(31, None),
    ),
}


@dataclass(frozen=True, slots=True)
class RealPlan:
    """What a real clip shows; see `Plan`."""

    town: str
    part: str
    data: Path

    @property
    def name(self) -> str:
        """Such as ``kitti-06-there``."""
        return f"{self.town}-{self.part}"

    @property
    def rig(self) -> str:
        """Name of the cameras."""
        return DRIVES[self.town].rig

    @property
    def mapped(self) -> bool:
        """Whether the map is made of it."""
        return self.part == "mapped"

    @property
    def reverse(self) -> bool:
        """Never: the cameras keep looking in the same direction."""
        return False

    def read(self) -> Clip:
        """The clip."""
        drive = DRIVES[self.town]
        pairs = [one for one in open_drive(self.data / drive.folder) if isinstance(one, StereoPair)]
        truth = drive.read_truth(self.data / drive.truth_file, [one.stamp_ns for one in pairs])
        frames = [(pair, _pose(truth, pair)) for pair in pairs]
        if self.part in {"mapped", "whole"}:
            chosen = frames[drive.mapped] if self.mapped else frames
        else:
            there = frames[drive.live]
            chosen = there + there[-2::-1] if self.part == "there" else there[::-1] + there[1:]
        return Clip(self, _restamped([pair for pair, _ in chosen]), [pose for _, pose in chosen])


def _pose(truth: Trajectory, pair: StereoPair) -> SE3:
    world_from_cam = truth.at(pair.stamp_ns)
    if world_from_cam is None:
        raise SequenceError(f"the frame at {pair.stamp_ns} ns has no true pose; each needs one")
    return world_from_cam


def _restamped(pairs: Sequence[StereoPair]) -> list[StereoPair]:
    """The pairs as far apart in time as they were, one after the other also where time ran back."""
    gaps_ns = (abs(b.stamp_ns - a.stamp_ns) for a, b in pairwise(pairs))
    stamps_ns = accumulate(gaps_ns, initial=pairs[0].stamp_ns)
    return [replace(pair, stamp_ns=at) for pair, at in zip(pairs, stamps_ns, strict=True)]


def real_plans() -> list[RealPlan]:
    """The clips of the drives that are below the folder of ENGRAM_DATA; none without it."""
    named = os.environ.get("ENGRAM_DATA")
    if not named:
        return []
    data, parts = Path(named), ("mapped", "there", "back")
    return [RealPlan(town, part, data) for town in real_drives(data) for part in parts]


def real_drives(data: Path) -> list[str]:
    """Names of the drives below a folder of real images."""
    return [town for town, drive in DRIVES.items() if (data / drive.folder).is_dir()]


def localised(scene: Scene, settings: Settings | None = None) -> tuple[list[Fix], list[str]]:
    """The fixes of a robot that meets a scene; fatal findings of its doctor."""
    clip, hint, fixes = scene.clip, scene.hint, list[Fix]()
    with scene.place.opened.robot(clip.pairs[0].camera, settings) as robot:
        for at, one in enumerate(scene.shown):
            if hint is not None and one.frame >= scene.start:
                robot.place_at(hint)
                hint = None
            fix = scene.place.fix(at, robot.step(one.pair), clip.world_from_cam[one.frame])
            fixes += [] if fix is None else [fix]
        return fixes, [one.code for one in robot.diagnosis.fatal]


def run_trial(number: int, fault: str, scene: Scene, right: frozenset[int] = frozenset()) -> Trial:
    """One drive with one fault, localised."""
    clip = scene.clip
    trial = Trial(number, fault, clip.plan.name, scene.start, scene.strength, made_by=MADE_BY)
    trial.driven_m = way_m(clip.world_from_cam)
    fixes, trial.refused = localised(scene)
    trial.frames, trial.fixes = len(scene.shown), len(fixes)
    false = [clip.world_from_cam[scene.shown[one.at].frame] for one in fixes if one.false]
    trial.false, trial.events = len(false), events(false)
    trial.worst_m = max((one.error_m for one in fixes), default=0.0)
    found = [one for one in fixes if not one.false]
    expected = right & {one.frame for one in scene.shown}
    trial.expected = len(expected)
    trial.lost = len(expected - {scene.shown[one.at].frame for one in found})
    after = [at for at, one in enumerate(scene.shown) if one.frame >= trial.start]
    again = [one.at - after[0] for one in found if after and one.at >= after[0]]
    trial.again = again[0] if again else None
    return trial


def clips() -> list[Plan]:
    """The clips of the study: rendered ones, and the real ones that ENGRAM_DATA names.

    With other real clips a number draws another clip; trials that are made stay.
    """
    return [*JUDGING, *REVERSED, *real_plans()]


def run(
    file: Path,
    trials: int,
    plans: Sequence[Plan] | None = None,
    monitor: Monitor = QUIET,
    only: Collection[str] = KINDS,
) -> Iterator[Trial]:
    """Makes the trials up to a number that are missing from a file of results, by place.

    Args:
        plans: the clips; None for `clips`. Rendered ones that the cache lacks are rendered first.
    """
    plans, made = clips() if plans is None else plans, TrialFile(file)
    wanted = [(n, drawn(n, plans)) for n in range(trials) if fault_of(n) in only]
    left = [(number, *one) for number, one in wanted if one and number not in made.numbers]
    right: dict[str, frozenset[int]] = {}
    for town in dict.fromkeys(plan.town for _, _, plan, _ in left):
        with (
            tempfile.TemporaryDirectory(prefix="engram-faults-") as folder,
            closing(Places(plans, town, Path(folder))) as places,
        ):
            for number, fault, plan, rng in left:
                if plan.town != town:
                    continue
                try:
                    trial = _trial(number, fault, plan, places, rng, right)
                except Exception as error:
                    error.add_note(f"in trial {number}: {fault}, {plan.name}")
                    raise
                if trial is None:
                    continue
                made.add(trial)
                monitor.advance(fault)
                monitor.check()
                yield trial


def _trial(
    number: int,
    fault: str,
    plan: Plan,
    places: Places,
    rng: np.random.Generator,
    right: dict[str, frozenset[int]],
) -> Trial | None:
    """One trial, localised and mapped; None if it cannot be staged.

    `right` remembers the frames of each clip with a right fix where nothing is wrong.
    """
    scene = staged(fault, plan, places, rng)
    if scene is None:
        return None
    if places.own and fault not in ELSEWHERE and plan.name not in right:
        clip = places.clip(plan)
        fixes, _ = localised(Scene(clip, places.own, 0, 0.0, undisturbed(clip.pairs)))
        right[plan.name] = frozenset(one.at for one in fixes if not one.false)
    trial = run_trial(number, fault, scene, right.get(plan.name, frozenset()))
    map_on(trial, scene, places.folder / "mapped.engram")
    return trial


_FIXES = (
    "trials", "frames", "fixes", "right fixes lost", "false", "events", "worst, m",
    "found again after (median, worst)", "never", "the doctor objects",
)  # fmt: skip
_MAPS = (
    "drives", "refused", "nodes", "edges", "join two places", "of drives not refused",
    "of odometry", "worst, m",
)  # fmt: skip


def page(trials: Sequence[Trial]) -> str:
    """Headline and tables in Markdown: what robots claimed, and what was done to maps."""
    parts = [headline(trials), _table(_FIXES, trials, _fixes)]
    mapped = [one for one in trials if one.nodes is not None]
    if mapped:
        parts += ["Drives mapped with `--force`:", _table(_MAPS, mapped, _maps)]
    return "\n\n".join(parts) + "\n"


def headline(trials: Sequence[Trial]) -> str:
    """What counts, in one line."""
    if not trials:
        return "no trials"
    km = sum(one.driven_m for one in trials) / 1e3
    events, worst_m = sum(one.events for one in trials), max(one.worst_m for one in trials)
    made_by = " and ".join(sorted({one.made_by for one in trials} - {""})) or "earlier versions"
    return (
        f"{len(trials)} trials of {made_by}, {km:.1f} km: {events} false events, "
        f"largest error claimed {worst_m:.2f} m"
    )


def _table(
    head: Sequence[str],
    trials: Sequence[Trial],
    cells: Callable[[Sequence[Trial]], Sequence[object]],
) -> str:
    """Faults with weaker and stronger halves of their strengths, real clips, all."""
    lines = [_line("fault", "strength", *head), _line(*["---"] * (2 + len(head)))]
    by_fault: dict[str, list[Trial]] = defaultdict(list)
    for one in trials:
        by_fault[one.fault].append(one)
    for fault in (kind for kind in KINDS if kind in by_fault):
        lines += [_line(fault, span, *cells(part)) for span, part in _parts(fault, by_fault[fault])]
    real = [one for one in trials if one.clip.startswith(tuple(DRIVES))]
    if real:
        lines.append(_line("all on real clips", "", *cells(real)))
    return "\n".join([*lines, _line("all", "", *cells(trials))])


def _parts(fault: str, rows: Sequence[Trial]) -> Iterator[tuple[str, Sequence[Trial]]]:
    what = STRENGTHS.get(fault)
    if what is None or what.weakest == what.strongest:
        yield "", rows
        return
    middle = float(np.sqrt(what.weakest * what.strongest))
    weak = [one for one in rows if one.strength < middle]
    strong = [one for one in rows if one.strength >= middle]
    for low, high, part in ((what.weakest, middle, weak), (middle, what.strongest, strong)):
        if part:
            yield f"{low:.3g}–{high:.3g} {what.unit}", part


def _fixes(rows: Sequence[Trial]) -> Sequence[object]:
    again = [one.again for one in rows if one.again is not None]
    expected = sum(one.expected for one in rows)
    return (
        len(rows), sum(one.frames for one in rows), sum(one.fixes for one in rows),
        f"{sum(one.lost for one in rows)} of {expected}" if expected else "–",
        sum(one.false for one in rows), sum(one.events for one in rows),
        f"{max((one.worst_m for one in rows), default=0.0):.2f}",
        f"{np.median(again):.0f}, {max(again)}" if again else "–",
        sum(one.again is None for one in rows), sum(bool(one.refused) for one in rows),
    )  # fmt: skip


def _maps(rows: Sequence[Trial]) -> Sequence[object]:
    return (
        len(rows), sum(bool(one.map_refused) for one in rows), sum(one.nodes or 0 for one in rows),
        sum(one.edges or 0 for one in rows), sum(one.joined for one in rows),
        sum(one.joined for one in rows if not one.map_refused),
        sum(one.joined_odometry for one in rows),
        f"{max((one.worst_edge_m for one in rows), default=0.0):.2f}",
    )  # fmt: skip


def _line(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"
