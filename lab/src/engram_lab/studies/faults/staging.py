"""A trial of the faults study: its frames, its map, the given positions, and its result."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import ConfigError
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.localisation import Localisation, Position
from engram.localiser.settings import METHOD_VERSION
from engram.maps.map import Map, open_map
from engram_lab.accuracy import Fix, is_false
from engram_lab.studies.faults.clips import Clip, ClipPlan, Plan
from engram_lab.studies.faults.injected import FAULTS, Shown, undisturbed

# A place is wrong that is so far off, m.
_OFF_M = 15.0
# Another town lies so far away that no place there is right by chance.
_OTHER_TOWN = SE3(np.eye(3), np.array([1e4, 0.0, 0.0]))


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A town that is mapped by its first clip."""

    path: Path
    opened: Map
    world_from_node: dict[NodeId, SE3]

    def fix(self, at: int, found: Localisation, world_from_cam: SE3) -> Fix | None:
        """The fix of a frame that was shown; None without one."""
        if found.node is None or found.node_from_live is None:
            return None
        node_from_live = self.world_from_node[found.node].inverse() @ world_from_cam
        wrong = node_from_live.inverse() @ found.node_from_live
        false = is_false(wrong.distance_m, wrong.angle_rad)
        return Fix(at, wrong.distance_m, false, found.confidence)

    def wrong_hint(
        self, world_from_cam: SE3, sigma_m: float, rng: np.random.Generator
    ) -> Position | None:
        """A wrong place for a camera, with a standard deviation; None if all are near."""
        far = [
            node
            for node, pose in self.world_from_node.items()
            if (world_from_cam.inverse() @ pose).distance_m >= _OFF_M
        ]
        if not far:
            return None
        covariance = np.diag([sigma_m**2] * 3 + [np.deg2rad(2.0) ** 2] * 3)
        return Position(far[int(rng.integers(len(far)))], SE3.identity(), covariance)


def mapped_by(clip: Clip, path: Path, world_from_town: SE3 | None = None) -> Place:
    """The place that a robot made that mapped a clip live.

    Args:
        path: the map; must not exist yet.
        world_from_town: where the town of the clip lies; None for the origin.
    """
    with (
        open_map(path, create=True) as opened,
        opened.robot(clip.pairs[0].camera, name="mapper", maps=True) as robot,
    ):
        for pair in clip.pairs:
            robot.step(pair)
    world_from_town = world_from_town or SE3.identity()
    truth = {
        pair.stamp_ns: world_from_town @ pose
        for pair, pose in zip(clip.pairs, clip.world_from_cam, strict=True)
    }
    found = open_map(path)
    return Place(path, found, {node.id: truth[node.stamp_ns] for node in found.graph.nodes})


def damaged(place: Place, path: Path, share: float, rng: np.random.Generator) -> Place:
    """A copy of a place in which the landmarks of some nodes, at least one, cannot be read."""
    shutil.copyfile(place.path, path)
    with closing(sqlite3.connect(path)) as connection, connection:
        rows = connection.execute("SELECT node, landmarks FROM frames ORDER BY node").fetchall()
        for row in rng.permutation(len(rows))[: max(1, round(share * len(rows)))]:
            node, landmarks = rows[row]
            connection.execute(
                "UPDATE frames SET landmarks = ? WHERE node = ?", (_spoilt(landmarks, rng), node)
            )
    return Place(path, open_map(path), place.world_from_node)


def _spoilt(landmarks: bytes, rng: np.random.Generator) -> bytes:
    """One byte changed, cut short, or nothing left."""
    at, how = int(rng.integers(len(landmarks))), int(rng.integers(3))
    if how == 0:
        return landmarks[:at] + bytes([landmarks[at] ^ 0x10]) + landmarks[at + 1 :]
    return landmarks[:at] if how == 1 else b""


class Places:
    """The maps of one town; the clips that are driven there.

    Args:
        folder: for the maps; must be empty.

    Attributes:
        own: the town's map; None if the clip for it is missing.
        other: that of another town, if possible by the same kind of camera; None without one.
    """

    def __init__(self, plans: Sequence[Plan], town: int | str, folder: Path) -> None:
        self.folder = folder
        maps = [plan for plan in plans if plan.mapped]
        own = next((plan for plan in maps if plan.town == town), None)
        others = [plan for plan in maps if plan.town != town]
        self.own = mapped_by(own.read(), folder / "own.engram") if own else None
        self.other: Place | None = None
        if own and others:
            nearest = min(others, key=lambda plan: plan.rig != own.rig)
            self.other = mapped_by(nearest.read(), folder / "other.engram", _OTHER_TOWN)
        self._damaged: Place | None = None
        self._clip: Clip | None = None

    def clip(self, plan: Plan) -> Clip:
        """A clip; the last one is kept."""
        if self._clip is None or self._clip.plan != plan:
            self._clip = plan.read()
        return self._clip

    def damaged(self, share: float, rng: np.random.Generator) -> Place | None:
        """The town's map with damaged landmarks, until the next one is requested."""
        self._close(self._damaged)
        path = self.folder / "damaged.engram"
        self._damaged = damaged(self.own, path, share, rng) if self.own else None
        return self._damaged

    def close(self) -> None:
        """Closes the maps."""
        for place in (self.own, self.other, self._damaged):
            self._close(place)

    def _close(self, place: Place | None) -> None:
        if place is not None:
            place.opened.close()


NONE = "none"
OTHER_TOWN = "map of another town"
CARRIED = "told a wrong place"
REVERSE = "driving in the other direction"
TURNED = "turned round unseen"
DAMAGED = "damaged landmarks"
KINDS = (NONE, OTHER_TOWN, CARRIED, REVERSE, TURNED, DAMAGED, *FAULTS)
# Of these, no frame of the clip has a right fix where nothing is wrong.
ELSEWHERE = frozenset({OTHER_TOWN, REVERSE, TURNED})
# Changes with what a number means, so that results of two meanings are not mixed.
DRAW = 3
# Frames before a fault, in which the robot finds itself, and after its start.
_BEFORE, _AFTER = 15, 25
# Frames of a drive that are shown, at most.
_WINDOW = 150


@dataclass(frozen=True, slots=True)
class Span:
    """Between which strengths are drawn, log-uniformly, in which unit."""

    unit: str
    weakest: float
    strongest: float


STRENGTHS = {
    CARRIED: Span("m", 0.1, 3.0),
    DAMAGED: Span("of the nodes", 0.02, 1.0),
    **{name: Span(one.unit, one.weakest, one.strongest) for name, one in FAULTS.items()},
}


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a robot meets.

    Attributes:
        hint: a wrong place that it is told at the start; None if it is told nothing.
    """

    clip: Clip
    place: Place
    start: int
    strength: float
    shown: list[Shown]
    hint: Position | None = None


def fault_of(number: int) -> str:
    """The fault of a trial."""
    return KINDS[number % len(KINDS)]


def drawn(number: int, plans: Sequence[Plan]) -> tuple[str, Plan, np.random.Generator] | None:
    """Fault and clip of a trial, the rest is drawn from the generator; None without such a clip."""
    rng = np.random.default_rng([number, 0xFA017])
    fault = fault_of(number)
    against = fault in {REVERSE, TURNED}
    live = [plan for plan in plans if not plan.mapped and plan.reverse == against]
    return (fault, live[int(rng.integers(len(live)))], rng) if live else None


def staged(fault: str, plan: Plan, places: Places, rng: np.random.Generator) -> Scene | None:
    """The scene of a trial; None without a map, or if it holds no wrong place to give."""
    clip, place = places.clip(plan), places.other if fault == OTHER_TOWN else places.own
    start = int(rng.integers(_BEFORE, max(_BEFORE + 1, len(clip) - _AFTER)))
    strength = _strength(fault, rng)
    if fault in FAULTS and FAULTS[fault].from_the_first:
        start = 0
    if fault == REVERSE:
        first = start - _BEFORE
        clip, start = Clip(plan, clip.pairs[first:], clip.world_from_cam[first:]), 0
    elif fault == TURNED:
        assert isinstance(plan, ClipPlan)  # no real clip is reversed
        clip = turned_round(places.clip(replace(plan, reverse=False)), clip, start)
    elif fault == DAMAGED:
        place, start = places.damaged(strength, rng), 0
    if place is None:
        return None
    scene = Scene(clip, place, start, strength, undisturbed(clip.pairs))
    if fault == CARRIED:
        hint = place.wrong_hint(clip.world_from_cam[start], strength, rng)
        return None if hint is None else replace(scene, hint=hint)
    if fault in FAULTS:
        shown = FAULTS[fault].apply(clip.pairs, strength, start, rng)
        return replace(scene, shown=shown[:_WINDOW])
    return scene


def _strength(fault: str, rng: np.random.Generator) -> float:
    span = STRENGTHS.get(fault)
    if span is None:
        return 0.0
    return float(np.exp(rng.uniform(np.log(span.weakest), np.log(span.strongest))))


def turned_round(forwards: Clip, back: Clip, start: int) -> Clip:
    """A clip until a frame, and from there on the opposite clip; its stamps continue."""
    here = forwards.world_from_cam[start - 1].translation
    off_m = [np.linalg.norm(pose.translation - here) for pose in back.world_from_cam]
    first = int(np.argmin(off_m))
    shift_ns = forwards.pairs[start].stamp_ns - back.pairs[first].stamp_ns
    behind = [replace(pair, stamp_ns=pair.stamp_ns + shift_ns) for pair in back.pairs[first:]]
    return Clip(
        back.plan,
        [*forwards.pairs[:start], *behind],
        [*forwards.world_from_cam[:start], *back.world_from_cam[first:]],
    )


MADE_BY = f"method {METHOD_VERSION}, draw {DRAW}"


@dataclass(slots=True)
class Trial:
    """Result of one trial.

    Attributes:
        worst_m: largest error of a fix, m; in another town 10 km.
        again: frames from the start of the fault until the first right fix; None if never.
        nodes, edges: what the drive added to the map, mapped with ``--force``; None where it was
            not mapped.
        worst_edge_m: the largest error of those edges, m.
    """

    number: int
    fault: str
    clip: str
    start: int
    strength: float
    frames: int = 0
    fixes: int = 0
    false: int = 0
    events: int = 0
    worst_m: float = 0.0
    again: int | None = None
    expected: int = 0
    lost: int = 0
    driven_m: float = 0.0
    refused: list[str] = field(default_factory=list)
    nodes: int | None = None
    edges: int | None = None
    joined: int = 0
    joined_odometry: int = 0
    worst_edge_m: float = 0.0
    map_refused: list[str] = field(default_factory=list)
    made_by: str = ""


def default_file(folder: Path) -> Path:
    """Where the trials of these versions are kept in a folder."""
    return folder / f"trials-{METHOD_VERSION}-{DRAW}.jsonl"


def read_trials(file: Path) -> list[Trial]:
    """The trials of a file; a line that a killed run left unfinished is left out."""
    if not file.exists():
        return []
    lines = file.read_text(encoding="utf-8").splitlines()
    rows: list[dict[str, Any]] = [json.loads(line) for line in lines if line.endswith("}")]
    return [Trial(**row) for row in rows]


class TrialFile:
    """A file of trials that is added to."""

    def __init__(self, path: Path) -> None:
        made = read_trials(path)
        others = {one.made_by or "an earlier version" for one in made} - {MADE_BY}
        if others:
            raise ConfigError(
                f"{path}: holds trials of {' and '.join(sorted(others))}, new ones are of "
                f"{MADE_BY}; name another file with --work, or report these with --report-only"
            )
        self.numbers = {one.number for one in made}
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.read_bytes().endswith(b"\n"):
            self._write("")  # ends the line that a killed run left unfinished

    def add(self, trial: Trial) -> None:
        """Writes one trial."""
        self._write(json.dumps(asdict(trial)))

    def _write(self, line: str) -> None:
        with self._path.open("a", encoding="utf-8") as out:
            out.write(f"{line}\n")
