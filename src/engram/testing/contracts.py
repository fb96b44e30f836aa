"""What every policy, reader and kind of features must do, as checks to run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias
from uuid import UUID

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import EngramError, SequenceError
from engram.frontend.features import FeatureKind, fitted_matcher
from engram.frontend.frame import BRIEF, Frame, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.cameras import CameraId, StereoCamera
from engram.graph.basin import MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    Attempt,
    Clock,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    PathId,
    Session,
    SessionId,
    node_id,
    path_id,
)
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import ALL_KINDS, Attempts, PathMemory
from engram.places.words import NodeWords
from engram.ranking.context import Background, Foreseen, RankingContext, RankingPolicy
from engram.ranking.lessons import Lessons
from engram.ranking.recent import Observations, RunAttempts
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.images import IMAGE_SUFFIXES
from engram.sequences.opening import Drive, SequenceFormat, layout_named, layout_names
from engram.sequences.sequence import (
    FrameRange,
    LoggedFrame,
    OpenOptions,
    first_pair_hash,
    session_of,
)


@dataclass(frozen=True, slots=True)
class Check:
    """One demand on a policy, a reader or a kind of features.

    Attributes:
        demand: in words.
        met: whether it is met.
        found: what was found.
    """

    demand: str
    met: bool
    found: str


def unmet(checks: Iterable[Check]) -> list[str]:
    """The unmet demands, each with what was found; a test asserts that the list is empty."""
    return [f"{check.demand}: {check.found}" for check in checks if not check.met]


_WALL_CAMERA = StereoCamera(260.0, 260.0, 160.0, 120.0, 0.2, 320, 240)
_STEP_PX, _DISPARITY_PX = 12, 12
_STEP_M = _WALL_CAMERA.baseline_m * _STEP_PX / _DISPARITY_PX
_WITHIN_M = 0.02
# Less and all corners look alike.
_LEAST_DIFFERENT = 0.25
_FEWEST_INLIERS = 100


def check_kind(kind: FeatureKind) -> list[Check]:
    """Runs a kind that stands in `FEATURES` on synthetic pairs; a second at most."""
    frontend = Frontend(FrontendConfig(descriptor=kind.name, thumbnails=False))
    first, again = (frontend.extract(_wall_pair(0, 0)) for _ in range(2))
    ahead = frontend.extract(_wall_pair(1, 1))
    landmarks = first.landmarks
    shape = (len(landmarks), kind.descriptor_bytes)
    same = np.array_equal(landmarks.descriptors, again.landmarks.descriptors)
    described = kind.describe(_wall_pair(0, 0).left, landmarks.pixels, landmarks.octaves)
    differ = float(np.bitwise_count(described ^ landmarks.descriptors).mean()) / 8
    return [
        Check(
            f"descriptors are (N, {kind.descriptor_bytes}) uint8",
            landmarks.descriptors.shape == shape and landmarks.descriptors.dtype == np.uint8,
            f"{landmarks.descriptors.shape} {landmarks.descriptors.dtype}",
        ),
        Check("equal images give equal bits", same, "equal" if same else "different"),
        Check(
            "describing the corners again gives the same bits but for 2 %",
            differ < 0.02,
            f"{100 * differ:.1f} % differ",
        ),
        _spread(landmarks.descriptors),
        _motion(kind, first, ahead),
    ]


def _spread(descriptors: NDArray[np.uint8]) -> Check:
    half = len(descriptors) // 2
    share = float(np.bitwise_count(descriptors[:half] ^ descriptors[-half:]).mean()) / 8
    return Check(
        f"different corners differ in {100 * _LEAST_DIFFERENT:.0f} % of the bits",
        share >= _LEAST_DIFFERENT,
        f"{100 * share:.0f} %",
    )


def _motion(kind: FeatureKind, reference: Frame, live: Frame) -> Check:
    config = fitted_matcher(MatcherConfig(), BRIEF, kind.name)
    match = match_frames(reference, live, config, seed=1)
    demand = f"{_FEWEST_INLIERS} landmarks agree on a motion, accurate to {1000 * _WITHIN_M:.0f} mm"
    if match.reference_from_live is None:
        return Check(demand, False, "no motion")
    off = match.reference_from_live.translation - np.array([_STEP_M, 0, 0])
    off_m = float(np.linalg.norm(off))
    met = match.inliers >= _FEWEST_INLIERS and off_m < _WITHIN_M
    return Check(demand, met, f"{match.inliers} landmarks, {1000 * off_m:.0f} mm off")


def _wall_pair(index: int, noise: int) -> StereoPair:
    """What a camera sees that drives along the wall; grey levels of noise."""
    draws = np.random.default_rng([noise, index])
    views = []
    for start in (_STEP_PX * index, _STEP_PX * index + _DISPARITY_PX):
        view = _wall()[:, start : start + 320] + draws.normal(0, 3 * noise, (240, 320))
        views.append(np.ascontiguousarray(np.clip(np.rint(view), 0, 255).astype(np.uint8)))
    return StereoPair(index + 1, views[0], views[1], _WALL_CAMERA)


def _wall() -> NDArray[np.float32]:
    draws, total = np.random.default_rng(5), np.zeros((240, 360), np.float32)
    for sigma in (1.0, 2.0, 5.0):
        layer = cv2.GaussianBlur(draws.standard_normal((240, 360), np.float32), (0, 0), sigma)
        total += layer / layer.std()
    return 128 + 30 * total


CAMERA = CameraId("0" * 32)
_HOUR_NS = 3_600_000_000_000


def session_uuid(number: int) -> SessionId:
    """Id of a session by its number."""
    return SessionId(UUID(int=(0x5E << 120) | number))


def path_uuid(number: int) -> PathId:
    """Id of a path by its number."""
    return PathId(UUID(int=(0xBA << 120) | number))


def make_node(session: int, index: int, driven_m: float | None = None) -> Node:
    """Node `index` of a session, one second after the one before, 1 m driven unless stated."""
    drive = session_uuid(session)
    stamp_ns = index * 1_000_000_000
    metres = float(index) if driven_m is None else driven_m
    return Node(node_id(drive, stamp_ns), drive, stamp_ns, CAMERA, metres)


def flat_graph(count: int, sessions: int = 1) -> ExperienceGraph:
    """Nodes without edges; sessions take turns in saving them."""
    graph = ExperienceGraph()
    for index in range(count):
        graph.add_node(make_node(index % sessions, index))
    return graph


def session_record(number: int, hour: float | None = None, day: int = 0) -> Session:
    """A drive on a day after 1970, at an hour by the sun; no clock without an hour."""
    start_ns = int(((hour or 0.0) + 24 * day) * _HOUR_NS)
    clock = Clock.UNKNOWN if hour is None else Clock.UTC
    return Session(session_uuid(number), "robot", CAMERA, start_ns, clock, longitude_deg=0.0)


class MadeUpWords(NodeWords):
    """Visual words of nodes as stated; nodes that are left out show none."""

    def __init__(
        self, graph: ExperienceGraph, of_nodes: Mapping[int, Sequence[int]], count: int = 50
    ) -> None:
        self.idf = np.linspace(1.0, 2.0, count)
        known = {node: shown for node, shown in of_nodes.items() if node < len(graph)}
        self._of_nodes = {graph.node(node).id: shown for node, shown in known.items()}

    def of_node(self, node: NodeId) -> NDArray[np.int32]:
        """(n,) int32 words of a node."""
        return np.array(self._of_nodes.get(node, []), np.int32)


# At how many metres driven, node, success rate, accepted.
RunAttempt = tuple[float, int, float, bool]
# Session, node, success rate, accepted.
Lesson = tuple[int, int, float, bool]


def run_of(attempts: Sequence[RunAttempt], driven_m: float = 0.0) -> RunAttempts:
    """This run's attempts, with 100 of 200 landmarks matched.

    The lower the rate the farther the node was, 0.9 being 0.5 m.
    """
    at_m, nodes, rates, accepted = zip(*attempts, strict=True) if attempts else ([], [], [], [])
    taken = np.array(accepted, np.bool_)
    return RunAttempts(
        driven_m,
        np.array(at_m, np.float64),
        np.array(nodes, np.int32),
        5 * (1 - np.array(rates, np.float64)),
        np.array(rates, np.float64),
        taken,
        np.where(taken, 100, 0),
        np.full(len(taken), 200),
    )


def memory_of(
    graph: ExperienceGraph,
    paths: Sequence[Sequence[int]],
    kinds: frozenset[PathEntryKind] = ALL_KINDS,
) -> PathMemory:
    """Path m holds the nodes (dense indices) of paths[m]."""
    memory = PathMemory(graph, kinds)
    for number, nodes in enumerate(paths):
        for sequence, index in enumerate(nodes):
            entry = PathEntry(
                path_uuid(number), sequence, graph.node(index).id, PathEntryKind.MATCHED, sequence
            )
            memory.add(entry)
    return memory


def neighbourhood_of(
    nodes: Sequence[int] | NDArray[np.int32], along_m: Sequence[float] | NDArray[np.float64]
) -> Neighbourhood:
    """Candidates straight ahead or behind, predicted without error.

    Args:
        nodes: (Y,) int32 dense indices.
        along_m: (Y,) float64, how far ahead each is, m.
    """
    nodes = np.asarray(nodes, np.int32)
    along = np.asarray(along_m, np.float64)
    poses = np.tile(np.eye(4), (len(nodes), 1, 1))
    poses[:, 2, 3] = along
    zeros = np.zeros(len(nodes))
    pivots = np.zeros((len(nodes), 3))
    return Neighbourhood(nodes, poses, np.abs(along), along, zeros, zeros, zeros, zeros, pivots)


def lessons_of(graph: ExperienceGraph, attempts: Sequence[Lesson]) -> Lessons:
    """What sessions learnt from attempts."""
    if not len(graph):
        return Lessons.none()
    count = max([int(graph.sessions.max()), *(attempt[0] for attempt in attempts)]) + 1
    viewers = [path_id(session_uuid(number)) for number in range(count)]
    made = [
        Attempt(drive, graph.node(node).id, graph.node(node).id, 0, 0, 0, 0, 0, accepted, 0, 0, "")
        for drive, node, _, accepted in attempts
    ]
    columns, ids = Attempts.of(made)
    index = np.array([graph.index(node) for node in ids], np.int32)
    columns = replace(columns, session=columns.iteration.astype(np.int32), node=index[columns.node])
    rates = np.array([rate for _, _, rate, _ in attempts], np.float64)
    return Lessons.learnt(graph, PathMemory(graph), viewers, columns, rates)


def make_context(
    *,
    graph: ExperienceGraph | None = None,
    paths: Sequence[Sequence[int]] = (),
    candidates: Sequence[int] = (),
    along_m: Sequence[float] | NDArray[np.float64] | None = None,
    observed: Sequence[int] = (),
    outcomes: Sequence[bool] = (),
    reference: int | None = None,
    own_path: PathId | None = None,
    focal_px: float = 256.0,
    stamp_ns: int = 0,
    seed: int = 0,
    sessions: int = 1,
    run: Sequence[RunAttempt] = (),
    hour: float | None = None,
    day: int | None = None,
    hours: Sequence[float | None] | None = None,
    words: Mapping[int, Sequence[int]] | None = None,
    live_words: Sequence[int] | None = None,
    lessons: Sequence[Lesson] = (),
) -> RankingContext:
    """A context over dense indices.

    Sessions take turns in saving nodes; `hours` is their hour of day, `words` what nodes show.
    `along_m`, (Y,) float64, is how far ahead each candidate is; 0.1 m apart unless stated.
    """
    along = np.arange(len(candidates)) / 10 if along_m is None else np.asarray(along_m, np.float64)
    if graph is None:
        attempted = [attempt[1] for attempt in (*run, *lessons)]
        on_paths = (node for path in paths for node in path)
        used = [*candidates, *observed, *on_paths, *attempted, reference or 0]
        graph = flat_graph(max(used, default=0) + 1, sessions)
    records = [session_record(number, hour) for number, hour in enumerate(hours or [])]
    return RankingContext(
        neighbourhood=neighbourhood_of(candidates, along),
        graph=graph,
        path_memory=memory_of(graph, paths),
        basin=MatchBasin.of(focal_px),
        observations=Observations(np.array(observed, np.int32), np.array(outcomes, np.bool_)),
        reference=reference,
        own_path=own_path,
        stamp_ns=stamp_ns,
        seed=seed,
        run=run_of(run),
        hour=hour,
        day=day,
        background=Background(
            {record.id: record for record in records},
            lessons_of(graph, lessons),
            None if words is None else MadeUpWords(graph, words),
        ),
        live_words=None if live_words is None else lambda: np.array(sorted(live_words), np.int32),
    )


def foreknown(context: RankingContext, seed: int = 0) -> RankingContext:
    """The context with made-up foresight, a property of the node and not of the row."""
    nodes = context.neighbourhood.nodes

    def foresee() -> Foreseen:
        draws = np.random.default_rng(seed)
        inliers = draws.integers(0, 4, len(context.graph)) * 10
        return Foreseen(inliers[nodes] >= 20, inliers[nodes])

    return replace(context, foresee=foresee)


def random_context(seed: int) -> RankingContext:
    """A situation drawn at random; few distances, so that ties are common, and much is missing."""
    draws = np.random.default_rng(seed)
    nodes = int(draws.integers(1, 26))

    def some() -> list[int]:
        return list(map(int, draws.permutation(nodes)[: draws.integers(0, nodes + 1)]))

    def maybe(value: float) -> float | None:
        return None if draws.random() < 0.4 else value

    def words() -> list[int]:
        return sorted(draws.permutation(10)[: draws.integers(0, 6)].tolist())

    candidates, observed = some(), some()
    run = [
        (float(draws.uniform(-50, 0)), int(draws.integers(nodes)), rate, bool(draws.integers(2)))
        for rate in draws.choice([0.0, 0.3, 0.9, np.nan], draws.integers(0, 13)).tolist()
    ]
    lessons = [
        (int(draws.integers(5)), int(draws.integers(nodes)), rate, bool(draws.integers(2)))
        for rate in draws.choice([0.0, 0.3, 0.9], draws.integers(0, 13)).tolist()
    ]
    context = make_context(
        graph=flat_graph(nodes, int(draws.integers(1, 6))),
        paths=[some() for _ in range(draws.integers(0, 9))],
        candidates=candidates,
        along_m=draws.choice([-3.0, -0.5, 0.0, 0.5, 1.0, 6.0], len(candidates)),
        observed=observed,
        outcomes=[bool(draws.integers(2)) for _ in observed],
        reference=int(draws.integers(nodes)) if draws.integers(2) else None,
        own_path=path_uuid(0) if draws.integers(2) else None,
        stamp_ns=int(draws.integers(2**62)),
        run=sorted(run, key=lambda attempt: attempt[0]),
        hour=maybe(draws.uniform(0, 24)),
        hours=[maybe(draws.uniform(0, 24)) for _ in range(draws.integers(0, 6))],
        words={node: words() for node in some()} if draws.integers(2) else None,
        live_words=words() if draws.integers(2) else None,
        lessons=lessons,
    )
    return foreknown(context, seed)


_SITUATIONS = 100


def check_policy(
    make: Callable[[], RankingPolicy], contexts: Sequence[RankingContext] | None = None
) -> list[Check]:
    """Runs a policy in made-up situations; a fraction of a second.

    Args:
        make: makes the policy, such as its class.
        contexts: the situations; None for a hundred at random.
    """
    given = [random_context(seed) for seed in range(_SITUATIONS)] if contexts is None else contexts
    first_day = foreknown(make_context(candidates=[4, 2, 7], along_m=[2.0, 0.5, 1.0], sessions=3))
    return [
        _checked_policy(
            "every row of the candidates stands once in the order", given, _orders(make)
        ),
        _checked_policy(
            "no candidates give an empty order", [foreknown(make_context())], _orders(make)
        ),
        _checked_policy(
            "a robot on its first day, without history, clock or words, gets an order",
            [first_day],
            _orders(make),
        ),
        _checked_policy("a used policy orders as a new one", given, _orders_again(make)),
        _checked_policy(
            "nodes come in the same order when rows are shuffled", given, _shuffled(make)
        ),
        _checked_policy("the robot's own path does not count", [_past()], _without_own_path(make)),
    ]


# The fault of a policy in one situation; "" for none.
_Fault = Callable[[RankingContext], str]


def _checked_policy(demand: str, contexts: Iterable[RankingContext], fault: _Fault) -> Check:
    faults = ((number, fault(context)) for number, context in enumerate(contexts))
    number, first = next(((number, text) for number, text in faults if text), (0, ""))
    return Check(demand, not first, f"{first} in situation {number}" if first else "yes")


def _orders(make: Callable[[], RankingPolicy]) -> _Fault:
    def fault(context: RankingContext) -> str:
        order: object = make().rank(context)
        rows = len(context.neighbourhood)
        if not isinstance(order, np.ndarray) or order.dtype != np.int64:
            return f"{order!r} is not an array of int64"
        whole = sorted(order.tolist()) == list(range(rows))
        return "" if whole else f"{order.tolist()} is not an order of {rows} rows"

    return fault


def _orders_again(make: Callable[[], RankingPolicy]) -> _Fault:
    def fault(context: RankingContext) -> str:
        policy = make()
        first = policy.rank(context)
        policy.rank(foreknown(make_context(candidates=[0, 1, 2], paths=[[0, 1]], reference=1)))
        return _difference(first, policy.rank(context)) or _difference(first, make().rank(context))

    return fault


def _shuffled(make: Callable[[], RankingPolicy]) -> _Fault:
    def fault(context: RankingContext) -> str:
        near = context.neighbourhood
        rows = np.random.default_rng(0).permutation(len(near))
        other = neighbourhood_of(near.nodes[rows], near.along_m[rows])
        moved = foreknown(replace(context, neighbourhood=other))
        return _difference(
            near.nodes[make().rank(foreknown(context))], other.nodes[make().rank(moved)]
        )

    return fault


_PATHS = ([4, 1, 5], [6, 2])


def _past(paths: Sequence[Sequence[int]] = _PATHS, own: int | None = None) -> RankingContext:
    """A map with paths, of which one is the robot's own."""
    return foreknown(
        make_context(
            paths=paths,
            own_path=None if own is None else path_uuid(own),
            candidates=[0, 1, 2, 3],
            observed=[4, 5, 6],
            outcomes=[True, True, False],
            reference=4,
        )
    )


def _without_own_path(make: Callable[[], RankingPolicy]) -> _Fault:
    with_own = _past((*_PATHS, [4, 3, 5]), own=len(_PATHS))
    return lambda context: _difference(make().rank(context), make().rank(with_own))


def _difference(first: NDArray[np.signedinteger], other: NDArray[np.signedinteger]) -> str:
    return "" if np.array_equal(first, other) else f"{first.tolist()}, then {other.tolist()}"


# Writes a drive of these pairs below an empty folder and returns the path that users name.
WriteDrive: TypeAlias = Callable[[Path, Sequence[StereoPair]], Path]

_DRIVE_CAMERA = StereoCamera(40.0, 40.0, 23.5, 15.5, 0.1, 48, 32)
_PAIRS, _START_NS, _PERIOD_NS = 6, 1_400_000_000_000_000_000, 100_000_000
# Stamps may be stored as decimal seconds.
_SAME_STAMP_NS = 1_000
# Rectification crops and bends, least in the middle; other images correlate far less there.
_ALIKE = 0.5
_SAME_CAMERA = 0.05


def check_reader(
    name: str, layout: SequenceFormat, write: WriteDrive, *, writes_camera: bool = True
) -> list[Check]:
    """Runs a reader on small drives of its layout; a fraction of a second.

    What concerns image files is left out for layouts without any.

    Args:
        name: the layout's name, as its entry point states it.
        layout: the reader.
        write: writes pairs in that layout: an empty folder, the pairs → the path that users name.
        writes_camera: whether `write` also stores the pairs' camera, which the reader must find.
    """
    with TemporaryDirectory() as folder:
        trial = _Trial(name, layout, write, Path(folder), writes_camera=writes_camera)
        return list(trial.checks())


class _Trial:
    def __init__(
        self,
        name: str,
        layout: SequenceFormat,
        write: WriteDrive,
        folder: Path,
        *,
        writes_camera: bool,
    ) -> None:
        self._name, self._layout, self._write, self._folder = name, layout, write, folder
        self._writes_camera = writes_camera
        self._pairs = [_drive_pair(index) for index in range(_PAIRS)]
        self._drive = self._written("drive")

    def checks(self) -> Iterator[Check]:
        yield _checked_drive(
            "it is recognised by its names, and as no other layout", self._recognition
        )
        yield _checked_drive("other files and folders are not taken for it", self._others)
        all_come = _checked_drive("all pairs come, with their stamps", self._stamps)
        yield all_come
        yield _checked_drive("--frames is a slice", self._slice)
        if not all_come.met or isinstance(self._open(self._drive), FrameLog):
            return
        yield _checked_drive(
            "images are (h, w) uint8 of the camera's size, left is left", self._images
        )
        yield _checked_drive("the camera is the one that was written", self._camera)
        yield _checked_drive("reading twice gives one session", self._session)
        if self._image_files(self._drive):
            yield _checked_drive("a damaged image is an error that names the file", self._damaged)
            yield _checked_drive(
                "--set drive.skip_bad=true leaves out a damaged pair and counts it", self._skipped
            )
            yield _checked_drive("a missing image costs its own pair", self._missing)

    def _written(self, name: str) -> Path:
        folder = self._folder / name
        folder.mkdir()
        return self._write(folder, self._pairs)

    def _open(self, path: Path, frames: str = "0::1", *, skip_bad: bool = False) -> Drive:
        options = OpenOptions(frames=FrameRange.parse(frames), skip_bad=skip_bad)
        return self._layout.open(path, options)

    def _recognition(self) -> str:
        if not self._layout.recognises(self._drive):
            return f"{self._drive.name} is not recognised"
        others = [name for name in layout_names() if name != self._name]
        claimants = [name for name in others if layout_named(name).recognises(self._drive)]
        return f"also recognised as {', '.join(claimants)}" if claimants else ""

    def _others(self) -> str:
        empty, note = self._folder / "empty", self._folder / "note.txt"
        empty.mkdir()
        note.write_text("no drive")
        taken = [
            path.name
            for path in (empty, note, self._folder / "nowhere")
            if self._layout.recognises(path)
        ]
        return f"{taken[0]} is taken for a drive" if taken else ""

    def _stamps(self) -> str:
        drive = self._open(self._drive)
        if drive.info.format != self._name:
            return f"info.format is {drive.info.format!r}, must be {self._name!r}"
        return _not_these(_stamps_of(drive), range(_PAIRS))

    def _slice(self) -> str:
        return _not_these(_stamps_of(self._open(self._drive, "1:6:2")), (1, 3, 5), first=1)

    def _images(self) -> str:
        drive = self._open(self._drive)
        size = (drive.camera.height, drive.camera.width)
        for index, (read, written) in enumerate(zip(_pairs_of(drive), self._pairs, strict=True)):
            for side, other in (("left", "right"), ("right", "left")):
                image = getattr(read, side)
                if image.dtype != np.uint8 or image.shape != size:
                    return f"{side} image {index} is {image.shape} {image.dtype}, must be {size}"
                own = _likeness(image, getattr(written, side))
                if own < _ALIKE or _likeness(image, getattr(written, other)) > own:
                    return f"{side} image {index} is another one (likeness {own:.2f})"
        return ""

    def _camera(self) -> str:
        camera = self._open(self._drive).camera
        for name in ("fx", "fy", "baseline_m") if self._writes_camera else ():
            wanted, value = getattr(_DRIVE_CAMERA, name), getattr(camera, name)
            if abs(value - wanted) > _SAME_CAMERA * wanted:
                return f"{name} is {value:g}, must be {wanted:g}"
        return ""

    def _session(self) -> str:
        sessions = set()
        for _ in range(2):
            drive = self._open(self._drive)
            first = _pairs_of(drive)[0]
            hashed = first_pair_hash(first)
            sessions.add(session_of(drive.info, drive.camera, first.stamp_ns, hashed).id)
        return "" if len(sessions) == 1 else "two sessions"

    def _damaged(self) -> str:
        path, image = self._spoilt("damaged")
        image.write_bytes(image.read_bytes()[:20])
        try:
            _stamps_of(self._open(path))
        except SequenceError as error:
            return "" if image.name in str(error) else f"{image.name} is not in: {error}"
        return "no SequenceError"

    def _skipped(self) -> str:
        path, image = self._spoilt("skipped")
        image.write_bytes(image.read_bytes()[:20])
        drive = self._open(path, skip_bad=True)
        read = len(_stamps_of(drive))
        good = (read, drive.skipped) == (_PAIRS - 1, 1)
        return "" if good else f"{read} pairs, {drive.skipped} skipped"

    def _missing(self) -> str:
        path, image = self._spoilt("missing")
        image.unlink()
        read = len(_stamps_of(self._open(path, skip_bad=True)))
        return "" if read == _PAIRS - 1 else f"{read} of {_PAIRS} pairs are left"

    def _spoilt(self, name: str) -> tuple[Path, Path]:
        """Another drive, and one of its images to spoil: of the left side if that sorts first."""
        path = self._written(name)
        files = self._image_files(path)
        return path, files[len(files) // 4]

    @staticmethod
    def _image_files(path: Path) -> list[Path]:
        return sorted(file for file in path.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES)


def _checked_drive(demand: str, fault: Callable[[], str]) -> Check:
    try:
        text = fault()
    except EngramError as error:
        text = str(error)
    return Check(demand, not text, text or "yes")


def _stamps_of(drive: Drive) -> NDArray[np.int64]:
    frames = (item.frame if isinstance(item, LoggedFrame) else item for item in drive)
    return np.array([frame.stamp_ns for frame in frames], np.int64)


def _pairs_of(drive: Drive) -> list[StereoPair]:
    return [pair for pair in drive if isinstance(pair, StereoPair)]


def _not_these(stamps_ns: NDArray[np.int64], wanted: Sequence[int], first: int = 0) -> str:
    """How stamps differ from those of the pairs `wanted`; the clock may begin anywhere."""
    if len(stamps_ns) != len(wanted):
        return f"{len(stamps_ns)} pairs, must be {len(wanted)}"
    expected_ns = _PERIOD_NS * (np.array(wanted) - first)
    off_ns = np.abs(stamps_ns - stamps_ns[0] - expected_ns)
    worst = int(off_ns.argmax())
    return "" if off_ns[worst] <= _SAME_STAMP_NS else f"pair {worst} is {off_ns[worst]} ns off"


def _likeness(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Correlation of the middle halves of two (h, w) images."""
    rows, columns = (slice(size // 4, -size // 4) for size in image.shape)
    return float(np.corrcoef(image[rows, columns].ravel(), other[rows, columns].ravel())[0, 1])


def _drive_pair(index: int) -> StereoPair:
    left, right = (_picture(index, side) for side in range(2))
    return StereoPair(_START_NS + index * _PERIOD_NS, left, right, _DRIVE_CAMERA)


def _picture(index: int, side: int) -> NDArray[np.uint8]:
    """(32, 48) uint8 clouds, others for every pair and side."""
    draws = np.random.default_rng([index, side])
    noise = draws.standard_normal((_DRIVE_CAMERA.height, _DRIVE_CAMERA.width), np.float32)
    clouds = cv2.GaussianBlur(noise, (0, 0), 3)
    scaled = 128 + 50 * (clouds - clouds.mean()) / clouds.std()
    return np.asarray(np.clip(np.rint(scaled), 0, 255), np.uint8)
