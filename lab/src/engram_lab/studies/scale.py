"""How the product grows with its map: cities of any size, and what a robot takes in them.

    engram lab evaluate scale --sizes 5000,20000,100000

A city is made of streets of 500 m, each driven five times: 2,500 nodes, 7.8 edges a node (odometry,
matches and proximity edges between the drives), 2.4 path entries and 46 attempts a node, one
revision a street. Its rows are written straight into the tables, since the product would take hours
over 10⁶ nodes. Only the streets around the one that is driven have landmarks that differ from
place to place.

Every measurement runs in a process of its own, a fork of one that has imported everything and read
the vocabulary. Times are of the processor.
"""

from __future__ import annotations

import multiprocessing
import resource
import shutil
import sqlite3
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import msgspec
import numpy as np
from sqlalchemy import Table

from engram import __version__
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.merging import merge
from engram.fleet.merge.replay import Replay, Segment
from engram.fleet.merge.report import SegmentReport
from engram.frontend.blobs import blob_hash, decode_landmarks
from engram.frontend.frame import Frame, FrameStatus
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Clock,
    Edge,
    EdgeKind,
    Node,
    PathEntry,
    PathEntryKind,
    Session,
    path_id,
)
from engram.graph.paths import Attempts
from engram.graph.placing import MAP_FROM_CAMERA
from engram.localiser.localisation import Position
from engram.maps import schema
from engram.maps.attempts import encode_words, pack
from engram.maps.history import blame_node, map_log, show_revision
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.rows import (
    camera_row,
    cell_of,
    covariance_bytes,
    session_row,
    to_json,
    transform_bytes,
)
from engram.maps.sqlite import SqliteDatabase
from engram.maps.upgrading import complete_history
from engram.maps.writer import RevisionWriter
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.places.vocabulary import Vocabulary, default_vocabulary, hash_of
from engram.places.words import NodeWords
from engram.robot.inspecting import describe_map
from engram.sequences.sequence import LoggedFrame
from engram.viewing.drawings import plot_map
from engram_lab.synthetic_places import (
    CAMERA,
    DESCRIPTOR,
    FRONTEND,
    drive_of,
    landmark_bytes,
    node_of,
    stored,
)

LANES = 5
LANDMARKS, FAR_LANDMARKS = 100, 12
BEGIN = 20  # the metre of the driven street at which the robot begins
LANE = 2  # along which drives are handed in
STEPS = 200
_TRIED = 46  # attempts of a drive per metre
_PERIOD_NS = 100_000_000
FIRST_NS = 1_600_000_000_000_000_000
_STEP_SIGMA = np.diag([0.01**2] * 3 + [0.002**2] * 3)
_MATCH_SIGMA = np.diag([0.02**2] * 3 + [0.004**2] * 3)
_STEP, _MATCH = covariance_bytes(_STEP_SIGMA), covariance_bytes(_MATCH_SIGMA)


@dataclass(frozen=True, slots=True)
class City:
    """Streets that turn right and left in turn; the robot drives along the one in the middle.

    Attributes:
        streets: how many.
        length: of each, in metres.
        distinct: so many streets on either side of the driven one have landmarks of their own.
    """

    streets: int
    length: int = 500
    distinct: int = 1

    @staticmethod
    def of(nodes: int) -> City:
        """A city of so many nodes, rounded down to whole streets, at least three."""
        return City(max(nodes // City(1).nodes, 3))

    @property
    def nodes(self) -> int:
        """Number of its nodes."""
        return self.streets * LANES * self.length

    @property
    def driven(self) -> int:
        """The street on which the robot drives."""
        return self.streets // 2

    def drive(self, street: int, lane: int) -> Session:
        """The drive along a lane of a street."""
        start_ns = FIRST_NS + (street * LANES + lane) * 3_600_000_000_000
        made = drive_of("fleet", start_ns, f"{street}-{lane}")
        return replace(made, clock=Clock.UTC, longitude_deg=0.0)

    def node(self, street: int, lane: int, metre: int) -> Node:
        """The node at a metre of a drive."""
        made = self.drive(street, lane)
        return node_of(made, made.start_ns + metre * _PERIOD_NS, float(metre))

    def pose(self, street: int, lane: int, metre: int) -> SE3:
        """Of a node's camera; lanes are half a metre apart."""
        ahead = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        turn = ahead if street % 2 else np.eye(3)
        begin = self.length * np.array([street // 2, 0.0, (street + 1) // 2])
        return SE3(turn, begin + turn @ np.array([0.5 * (lane - LANES // 2), 0.0, float(metre)]))

    def seed(self, street: int, metre: int) -> int:
        """Draws the landmarks at a metre of a street that has its own."""
        return street * self.length + metre

    def frame(self, metre: int) -> LoggedFrame:
        """What a live camera sees at a metre of the driven street, from metre `BEGIN` on."""
        return self._seen((self.seed(self.driven, metre), 0), metre)

    def changed(self, metre: int) -> LoggedFrame:
        """What it sees there once the street has changed."""
        return self._seen((self.seed(self.driven, metre), 1), metre)

    def _seen(self, place: tuple[int, int], metre: int) -> LoggedFrame:
        drawn = np.random.default_rng(place)
        blob = landmark_bytes(drawn, np.random.default_rng((metre, 7)), LANDMARKS)
        landmarks = decode_landmarks(blob, CAMERA, DESCRIPTOR)
        stamp_ns = 2 * FIRST_NS + metre * _PERIOD_NS
        frame = Frame(stamp_ns, CAMERA, landmarks, DESCRIPTOR, FRONTEND, FrameStatus.OK)
        return LoggedFrame(frame, _AHEAD if metre > BEGIN else OdometryStep(OdometryStatus.FIRST))

    def keep(self, path: Path) -> None:
        """Writes its map unless it is there already."""
        if not path.exists():
            draft = path.with_suffix(".draft.engram")
            draft.unlink(missing_ok=True)
            self.write(draft)
            draft.rename(path)

    def write(self, path: Path) -> None:
        """Writes its map."""
        Map.create(path).close()
        with closing(sqlite3.connect(path)) as database:
            database.execute("PRAGMA synchronous=off")
            database.execute("PRAGMA cache_size=-200000")
            rows = _Rows(self, database)
            for street in range(self.streets):
                rows.write_street(street)
                if street % 10 == 9:
                    database.commit()
            database.commit()
        with closing(SqliteDatabase(path)) as made, made.writing() as connection:
            complete_history(connection)
        with Map.open(path, writes=True) as opened:
            NodeWords.of_map(opened, _vocabulary()).keep_missing()


_AHEAD = OdometryStep(
    OdometryStatus.OK, SE3(np.eye(3), np.array([0.0, 0.0, 1.0])), _STEP_SIGMA, LANDMARKS
)
_encode = msgspec.msgpack.Encoder().encode


class _Rows:
    """Rows of a city, written street after street."""

    def __init__(self, city: City, database: sqlite3.Connection) -> None:
        self._city, self._database = city, database
        self._rng = np.random.default_rng(1)
        self._keys = dict.fromkeys(schema.KEYED, 0)
        self._tried = [_attempts(self._rng, city.length) for _ in range(3)]
        self._between = cache(self._between_uncached)
        self._rows: dict[Table, list[tuple[Any, ...]]] = {}
        self._put(schema.cameras, **camera_row(CAMERA, self._next(schema.cameras)))
        one = {"key": 1, "descriptor": str(DESCRIPTOR), "hash": FRONTEND}
        self._put(schema.frontends, **one)
        self._write()

    def write_street(self, street: int) -> None:
        """Writes a street as one revision."""
        city, revision = self._city, street + 1
        first = self._keys[schema.nodes] + 1
        for lane in range(LANES):
            self._write_drive(revision, street, lane, first)
        if street:
            for lane in range(LANES):
                begin = first + lane * city.length
                last = begin - LANES * city.length + city.length - 1
                before = city.pose(street - 1, lane, city.length - 1)
                between = transform_bytes(before.inverse() @ city.pose(street, lane, 0))
                self._edge(revision, last, begin, EdgeKind.MATCH, between, _MATCH)
        contents: dict[str, float] = dict.fromkeys((one.name for one in schema.VERSIONED), 0)
        contents |= {
            one.name: len(rows) for one, rows in self._rows.items() if one.name in contents
        }
        tried = LANES * _TRIED * city.length
        contents |= {"attempts": tried, "mapped_m": LANES * (city.length - 1.0)}
        self._put(
            schema.revisions,
            key=revision,
            number=revision,
            status="committed",
            parent=revision - 1 or None,
            author="city",
            message=f"street {street}",
            tool_version=__version__,
            configuration="{}",
            contents=to_json(contents),
            opened_ns=FIRST_NS + 2 * street,
            committed_ns=FIRST_NS + 2 * street + 1,
            host="",
            pid=1,
            writer="",
            ranges="{}",
            totals="{}",
            chain="",
        )
        self._write()

    def _write_drive(self, revision: int, street: int, lane: int, first: int) -> None:
        made, length = self._city.drive(street, lane), self._city.length
        session, path = self._next(schema.sessions), self._next(schema.paths)
        self._put(schema.sessions, **session_row(made, session, revision, 1, 1))
        named = {"key": path, "uuid": path_id(made.id).bytes, "revision": revision}
        self._put(schema.paths, **named, session=session, partial=0)
        sequence = 0
        for metre in range(length):
            key = self._node(revision, session, street, lane, metre)
            if metre:
                step = self._between(street % 2, lane, metre - 1, lane, metre)
                self._edge(revision, key - 1, key, EdgeKind.ODOMETRY, step, _STEP)
            for there in range(metre - 4, metre + 5) if lane else ():
                if 0 <= there < length:
                    other = int(self._rng.integers(0, lane))
                    kind = EdgeKind.MATCH if (there - metre) % 2 else EdgeKind.PROXIMITY
                    between = self._between(street % 2, other, there, lane, metre)
                    self._edge(revision, first + other * length + there, key, kind, between, _MATCH)
            matched = [first + int(other) * length + metre for other in self._rng.permutation(lane)]
            kinds = [PathEntryKind.SAVED, *[PathEntryKind.MATCHED] * len(matched[:2])]
            for taken, entry in zip(kinds, [key, *matched[:2]], strict=True):
                self._put(
                    schema.path_entries,
                    key=self._next(schema.path_entries),
                    revision=revision,
                    path=path,
                    sequence=sequence,
                    node=entry,
                    kind=str(taken),
                    stamp_ns=made.start_ns + metre * _PERIOD_NS,
                )
                sequence += 1
        tried = self._tried[lane % len(self._tried)]
        moved = replace(tried, reference=tried.reference + first, node=tried.node + first)
        for packed in pack(moved):
            row = {"key": self._next(schema.attempts), "revision": revision, "session": session}
            self._put(schema.attempts, **row, **packed)

    def _node(self, revision: int, session: int, street: int, lane: int, metre: int) -> int:
        city = self._city
        made, key = city.node(street, lane, metre), self._next(schema.nodes)
        near = abs(street - city.driven) <= city.distinct
        blob, digest, words = _place(city.seed(street, metre) if near else -(metre % 64) - 1)
        self._put(
            schema.nodes,
            key=key,
            uuid=made.id.bytes,
            revision=revision,
            session=session,
            camera=1,
            frontend=1,
            stamp_ns=made.stamp_ns,
            driven_m=made.driven_m,
            status=str(FrameStatus.OK),
            landmark_hash=digest,
        )
        self._put(schema.frames, node=key, revision=revision, landmarks=blob, thumbnail=None)
        self._put(schema.words, node=key, vocabulary=hash_of(_vocabulary()), body=words)
        placed = {"key": self._next(schema.placements), "revision": revision, "node": key}
        pose = SE3(MAP_FROM_CAMERA.copy(), np.zeros(3)) @ city.pose(street, lane, metre)
        self._put(
            schema.placements, **placed, map_from_node=transform_bytes(pose), cell=cell_of(pose)
        )
        return key

    def _between_uncached(self, turned: int, lane_a: int, a: int, lane_b: int, b: int) -> bytes:
        city = self._city
        return transform_bytes(
            city.pose(turned, lane_a, a).inverse() @ city.pose(turned, lane_b, b)
        )

    def _edge(
        self, revision: int, a: int, b: int, kind: EdgeKind, a_from_b: bytes, covariance: bytes
    ) -> None:
        self._put(
            schema.edges,
            key=self._next(schema.edges),
            revision=revision,
            a=a,
            b=b,
            kind=str(kind),
            a_from_b=a_from_b,
            covariance=covariance,
        )

    def _next(self, table: Table) -> int:
        self._keys[table] += 1
        return self._keys[table]

    def _put(self, table: Table, **values: Any) -> None:
        row = [values[name] for name in _columns(table)]
        self._rows.setdefault(table, []).append((*row, zlib.crc32(_encode(row))))

    def _write(self) -> None:
        for table, rows in self._rows.items():
            places = ",".join("?" * len(rows[0]))
            self._database.executemany(f"INSERT INTO {table.name} VALUES ({places})", rows)
        self._rows.clear()


@cache
def _columns(table: Table) -> tuple[str, ...]:
    return tuple(column.name for column in table.columns)[:-1]


@cache
def _vocabulary() -> Vocabulary:
    return default_vocabulary(DESCRIPTOR)


@cache
def _place(seed: int) -> tuple[bytes, bytes, bytes]:
    """Landmarks, their hash and words of a place; a negative seed draws one of the far streets."""
    count = LANDMARKS if seed >= 0 else FAR_LANDMARKS
    blob = landmark_bytes(np.random.default_rng((abs(seed), int(seed < 0))), None, count)
    landmarks = decode_landmarks(blob, CAMERA, DESCRIPTOR)
    words = _vocabulary().words_of(landmarks.descriptors, DESCRIPTOR)
    return blob, blob_hash(blob), encode_words(words)


def _attempts(rng: np.random.Generator, length: int) -> Attempts:
    """Attempts of a drive at nodes of its street, by number within the street."""
    count = _TRIED * length
    metre = np.sort(rng.integers(4, length - 4, count))
    lanes, off = rng.integers(0, LANES, (2, count)), rng.integers(-4, 5, count)
    drawn = {
        name: rng.uniform(-0.3, 0.3, count).astype(np.float32) for name in ("across_m", "yaw_rad")
    } | {
        name: rng.uniform(0.01, 0.5, count).astype(np.float32)
        for name in ("sigma_m", "sigma_yaw_rad")
    }
    return Attempts(
        session=np.zeros(count, np.int32),
        iteration=metre.astype(np.int64),
        reference=(lanes[0] * length + metre).astype(np.int64),
        node=(lanes[1] * length + metre + off).astype(np.int64),
        along_m=off.astype(np.float32),
        **drawn,
        accepted=rng.random(count) < np.exp(-np.abs(off) / 3),
        inliers=rng.integers(0, 300, count).astype(np.int32),
        rank=rng.integers(0, 20, count).astype(np.int32),
        policy=np.zeros(count, np.int32),
        policies=("recall",),
    )


# -- measurements: each takes a map and its city, and gives figures by name


def drive_in(path: Path, city: City) -> dict[str, float]:
    """Opens the map and lets a robot drive on from a known place; it looks for none elsewhere."""
    frames = [city.frame(BEGIN + step) for step in range(min(STEPS, city.length - BEGIN))]
    known = city.node(city.driven, 2, BEGIN)
    before_mb, begun = resident_mb(), time.process_time()
    with Map.open(path) as opened, opened.robot(CAMERA, relocaliser=None) as robot:
        certain = np.diag([0.1**2] * 3 + [0.01**2] * 3)
        robot.place_at(Position(known.id, SE3.identity(), certain))
        taken, localised = [], 0
        for frame in frames:
            found = robot.step(frame)
            taken.append(time.process_time() - begun)
            localised += found.localised
        steps_ms = 1e3 * np.diff(taken)
        return {
            "open and first step (s)": taken[0],
            "step (ms)": float(np.median(steps_ms)),
            "step, 99th percentile (ms)": float(np.percentile(steps_ms, 99)),
            "memory (MB)": resident_mb() - before_mb,
            "localised (%)": 100 * localised / len(frames),
        }


def lost_in(path: Path, city: City) -> dict[str, float]:
    """Opens the map and lets a robot find itself without a known place."""
    before_mb, begun = resident_mb(), time.process_time()
    with Map.open(path) as opened, opened.robot(CAMERA) as robot:
        taken, found_at = [], None
        for step in range(20):
            result = robot.step(city.frame(BEGIN + step))
            taken.append(time.process_time() - begun)
            if result.localised and found_at is None:
                found_at = step + 1
        return {
            "lost: open and first proposals (s)": taken[0],
            "lost: frames until found": np.nan if found_at is None else found_at,
            "lost: memory (MB)": resident_mb() - before_mb,
        }


def map_in(path: Path, city: City) -> dict[str, float]:
    """Maps a drive of which half is new, in a copy of the map."""
    with TemporaryDirectory(dir=path.parent) as folder:
        shutil.copy(path, copied := Path(folder) / path.name)
        before_mb, begun = resident_mb(), time.process_time()
        with Map.open(copied) as opened:
            robot = opened.robot(CAMERA, name="mapper", maps=True)
            certain = np.diag([0.1**2] * 3 + [0.01**2] * 3)
            robot.place_at(Position(city.node(city.driven, 2, BEGIN).id, SE3.identity(), certain))
            taken, saved, metres = [], 0, min(STEPS, city.length - BEGIN)
            stretch = min(20, metres // 2)
            for step in range(metres):
                look = city.changed if (step // stretch) % 2 else city.frame
                saved += robot.step(look(BEGIN + step)).saved is not None
                taken.append(time.process_time() - begun)
            grown_mb, driven = resident_mb() - before_mb, time.process_time()
            robot.close()
            return {
                "mapping: open and first step (s)": taken[0],
                "mapping: step (ms)": float(np.median(1e3 * np.diff(taken))),
                "mapping: saved nodes": saved,
                "mapping: close and commit (s)": time.process_time() - driven,
                "mapping: memory (MB)": grown_mb,
            }


def write_in(path: Path, city: City) -> dict[str, float]:
    """Writes drives of 50 nodes and of one to a copy of the map, next to the driven street."""
    found: dict[str, float] = {}
    with TemporaryDirectory(dir=path.parent) as folder:
        shutil.copy(path, copied := Path(folder) / path.name)
        with Map.open(copied, writes=True) as opened:
            _write_drive(opened, city, 0, 2)  # what is loaded and compiled once is not counted
            for number, count in enumerate((50, 1), start=1):
                taken = _write_drive(opened, city, number, count)
                for name, seconds in zip(("begin", "checkpoint", "commit"), taken, strict=True):
                    found[f"{name}, {count} nodes (s)"] = seconds
    return found


def _write_drive(opened: Map, city: City, number: int, count: int) -> list[float]:
    """A drive past the nodes of a lane; seconds that its begin, checkpoint and commit take."""
    made = drive_of("late", 2 * FIRST_NS + number * 3_600_000_000_000, str(number))
    nodes = [node_of(made, made.start_ns + at * _PERIOD_NS, float(at)) for at in range(count)]
    blob = landmark_bytes(np.random.default_rng(number), None, LANDMARKS)
    marks = [time.process_time()]
    writer = opened.begin_session(
        made, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND, author="scale", configuration={}
    )
    marks.append(time.process_time())
    step = SE3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.01, 0.0]))
    beside = SE3.exp(np.array([0.5, 0.0, 0.1, 0.0, 0.0, 0.0]))
    for at, node in enumerate(nodes):
        writer.copy_node(stored(node, blob))
        if at:
            writer.add_edge(Edge(nodes[at - 1].id, node.id, EdgeKind.ODOMETRY, step, _STEP_SIGMA))
        if at % 5 == 0:
            other = city.node(city.driven, 2, at % city.length)
            writer.add_edge(Edge(other.id, node.id, EdgeKind.MATCH, beside, _MATCH_SIGMA))
    filled = time.process_time()
    writer.checkpoint()
    marks.append(marks[-1] + time.process_time() - filled)
    checked = time.process_time()
    writer.commit()
    marks.append(marks[-1] + time.process_time() - checked)
    return np.diff(marks).tolist()


def ask(path: Path, city: City) -> dict[str, float]:
    """What people ask of a map: seconds that each question takes."""
    node = str(city.node(city.driven, 1, 10).id)
    return _seconds(
        {
            "info": lambda: describe_map(path),
            "log": lambda: map_log(path),
            "show NODE": lambda: blame_node(path, node),
            "goal": lambda: _goal_in(path, city),
            "plot": lambda: _plot(path),
        }
    )


def look_back(path: Path, city: City) -> dict[str, float]:
    """What a drive of 500 nodes changed in a copy of the map, and what its revert would change."""
    with TemporaryDirectory(dir=path.parent) as folder:
        shutil.copy(path, copied := Path(folder) / path.name)
        with Map.open(copied, writes=True) as opened:
            _write_drive(opened, city, 0, 500)
            return _seconds(
                {
                    "show": lambda: show_revision(copied, "head"),
                    "diff": lambda: opened.diff("head~1", "head").text(),
                    "check --since": lambda: check_file(copied, since="head~1"),
                    "tag": lambda: opened.tag("seen", author="scale"),
                    "revert --dry-run": lambda: opened.revert("head", author="", dry_run=True),
                    "revert": lambda: opened.revert("head", author="scale"),
                }
            )


def _seconds(questions: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    found = {}
    for name, question in questions.items():
        begun = time.process_time()
        question()
        found[f"{name} (s)"] = time.process_time() - begun
    return found


def merge_in(path: Path, city: City) -> dict[str, float]:
    """Merges drives into a copy of the map: half of their nodes are its own.

    The others are those of `write_drive`.
    """
    found: dict[str, float] = {}
    with TemporaryDirectory(dir=path.parent) as folder:
        shutil.copy(path, centre := Path(folder) / path.name)
        before_mb = peak_mb()
        for count in (4, 50, 500):  # the first writes the blocks of places, once
            _hand_in(path, robot := Path(folder) / f"robot-{count}.engram", city, count)
            with _timed_replay() as replayed:
                begun = time.process_time()
                merge(centre, [robot])
                whole = time.process_time() - begun
            found[f"merge, {count} nodes, beyond the replay (s)"] = whole - replayed[0]
            found[f"merge, {count} nodes, replay (s)"] = replayed[0]
            begun = time.process_time()
            merge(centre, [robot])
            found[f"merge again, {count} nodes (s)"] = time.process_time() - begun
        found["merges, peak (MB)"] = peak_mb() - before_mb
    return found


@contextmanager
def _timed_replay() -> Iterator[list[float]]:
    """Counts the seconds that replays of segments take meanwhile."""
    taken, replay = [0.0], Replay.segment

    def timed(self: Replay, session: Session, segment: Segment) -> SegmentReport:
        begun = time.process_time()
        try:
            return replay(self, session, segment)
        finally:
            taken[0] += time.process_time() - begun

    with mock.patch.object(Replay, "segment", timed):
        yield taken


def _hand_in(source: Path, target: Path, city: City, count: int) -> None:
    """A robot's map of so many nodes, half of them of the city."""
    places = range(BEGIN, BEGIN + min(count // 2, city.length - BEGIN))
    known = [city.node(city.driven, LANE, metre) for metre in places]
    made = drive_of("robot", 3 * FIRST_NS, str(count))
    with (
        Map.open(source) as fleet,
        Map.create(target) as own,
        own.begin_revision(author="scale", message="", configuration={}) as writer,
    ):
        for session in (fleet.sessions[known[0].session], made):
            writer.add_session(session, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
        for one in fleet.frames.stored(known):
            writer.copy_node(one)
        write_drive(writer, city, made, city.driven, places)
        writer.commit()


def write_drive(
    writer: RevisionWriter, city: City, made: Session, street: int, places: range
) -> None:
    """Saves a drive along a lane of a street, tied to the lane at the first metre.

    Every second ten metres look as the street does, the rest as nowhere else.

    Args:
        writer: of a map that holds that node of the lane, and the session.
        city: where it drives.
        made: the drive's session.
        street: one that has landmarks of its own.
        places: metres of the street.
    """
    known = city.node(street, LANE, places[0])
    step, before = SE3(np.eye(3), np.array([0.0, 0.0, 1.0])), known
    for at, metre in enumerate(places):
        seed = city.seed(street, metre) + (0 if (at // 10) % 2 == 0 else 10**6)
        look = np.random.default_rng((at, 7))
        blob = landmark_bytes(np.random.default_rng((seed, 0)), look, LANDMARKS)
        node = node_of(made, made.start_ns + at * _PERIOD_NS, float(at))
        writer.copy_node(stored(node, blob))
        writer.add_edge(
            Edge(before.id, node.id, EdgeKind.ODOMETRY, step, _STEP_SIGMA)
            if at
            else Edge(known.id, node.id, EdgeKind.MATCH, SE3.identity(), _MATCH_SIGMA)
        )
        entry = PathEntry(path_id(made.id), at, node.id, PathEntryKind.SAVED, node.stamp_ns)
        writer.add_path_entry(entry)
        before = node


def download_in(path: Path, city: City) -> dict[str, float]:
    """Downloads around a node of the driven street: seconds and the largest peak of memory."""
    near, route = (
        str(city.node(city.driven, 2, city.length // 2).id),
        str(city.drive(city.driven, 2).id),
    )
    around = DownloadOptions("region", near=(near,), radius_m=200.0)
    asked = {
        "region, 200 nodes": DownloadOptions("region", near=(near,)),
        "region, 2,000 nodes": around,
        "route, 2,700 nodes": DownloadOptions("route", route=route),
        "tod+paths of 2,000 nodes": replace(around, select="tod+paths", depart_h=12.0),
        "5 MB of 2,000 nodes": replace(around, select="budget", budget_bytes=5_000_000),
    }
    found: dict[str, float] = {}
    before_mb = peak_mb()
    with TemporaryDirectory(dir=path.parent) as folder:
        for name, options in asked.items():
            begun = time.process_time()
            download(path, Path(folder) / "out.engram", options)
            found[f"download {name} (s)"] = time.process_time() - begun
            (Path(folder) / "out.engram").unlink()
    return found | {"downloads, peak (MB)": peak_mb() - before_mb}


def _goal_in(path: Path, city: City) -> None:
    """Finds the node for a goal on the driven street."""
    x_m, y_m, _ = MAP_FROM_CAMERA @ city.pose(city.driven, 1, 10).translation
    with Map.open(path) as opened:
        opened.frame.goal(float(x_m), float(y_m), 0.0)


def _plot(path: Path) -> None:
    with TemporaryDirectory() as folder:
        plot_map(path, Path(folder) / "plot.png")


MEASURES: Mapping[str, Callable[[Path, City], dict[str, float]]] = {
    "robot": drive_in,
    "lost": lost_in,
    "mapping": map_in,
    "writing": write_in,
    "questions": ask,
    "history": look_back,
    "merge": merge_in,
    "download": download_in,
}


def resident_mb() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


def peak_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


@dataclass(frozen=True, slots=True)
class Figures:
    """What was measured in one city.

    Attributes:
        nodes: size of the city.
        values: figures by name.
    """

    nodes: int
    values: Mapping[str, float]


def measure(
    sizes: Iterable[int], folder: Path, measures: Iterable[str] = tuple(MEASURES)
) -> Iterable[Figures]:
    """Measures cities of these sizes; those that the folder holds already are taken as they are.

    Args:
        sizes: numbers of nodes, rounded down to whole streets.
        folder: of the maps.
        measures: keys of `MEASURES`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _vocabulary()
    for size in sizes:
        city = City.of(size)
        path = folder / f"city-{city.nodes}.engram"
        city.keep(path)
        values: dict[str, float] = {}
        for name in measures:
            values |= _in_a_child(name, path, city)
        yield Figures(city.nodes, values)


def _in_a_child(name: str, path: Path, city: City) -> dict[str, float]:
    with multiprocessing.get_context("fork").Pool(1) as pool:
        return pool.apply(MEASURES[name], (path, city))


def table(found: Iterable[Figures]) -> str:
    """The figures as a Markdown table, one column a city."""
    found = list(found)
    names = dict.fromkeys(name for one in found for name in one.values)
    lines = [
        "| | " + " | ".join(f"{one.nodes:,}" for one in found) + " |",
        "| --- |" + " --- |" * len(found),
    ]
    for name in names:
        cells = (f"{one.values[name]:.4g}" if name in one.values else "" for one in found)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
