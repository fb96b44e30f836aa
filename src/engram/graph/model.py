"""Records of a map's graph: nodes, edges, sessions; anchors, goals and other marks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache
from hashlib import sha1
from typing import NewType, Protocol, TypeAlias
from uuid import UUID, uuid5

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Frame
from engram.geometry.cameras import CameraId
from engram.geometry.se3 import SE3

SessionId = NewType("SessionId", UUID)
NodeId = NewType("NodeId", UUID)
PathId = NewType("PathId", UUID)

# Namespace of all name-based UUIDs of Engram.
ENGRAM_NAMESPACE = UUID("6f1d1f0e-27e5-5c0e-9d6b-3c8a5c1e7a10")


class Clock(StrEnum):
    """Clock of a session's stamps (method §2.8)."""

    UTC = "utc"
    RELATIVE = "relative"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Session:
    """One drive of one robot.

    Attributes:
        id: the same for each reading of the drive (`session_id`).
        robot: name of the robot.
        camera: its camera.
        start_ns: stamp of the first pair, ns.
        clock: clock of the stamps.
        longitude_deg: longitude of the drive, degrees east, for mean solar time; None if unknown.
        zone: IANA time zone, used without a longitude; None if unknown.
        shift_ns: offset from stamps to UTC, ns; not 0 if the start was amended.
        recorded: the session as it was mapped, if it was amended; else None.
    """

    id: SessionId
    robot: str
    camera: CameraId
    start_ns: int
    clock: Clock = Clock.UNKNOWN
    longitude_deg: float | None = None
    zone: str | None = None
    shift_ns: int = 0
    recorded: Session | None = field(default=None, compare=False, repr=False)

    @property
    def begin_ns(self) -> int:
        """Start of the session by its clock, with amendments, ns."""
        return self.start_ns + self.shift_ns

    @property
    def as_recorded(self) -> Session:
        """The session as recorded, without amendments."""
        return self.recorded or self


# Characters of a robot's name: a line of any screen shows it, and every session carries it.
LONGEST_NAME = 200


class Amendable(StrEnum):
    """Fields of a session that may be corrected later."""

    ROBOT = "robot"  # the name that is shown
    ZONE = "zone"  # IANA time zone; it counts before a longitude
    START = "start"  # of the first pair, ns, UTC


@dataclass(frozen=True, slots=True)
class Amendment:
    """A correction to a session, whose record stays unchanged.

    Attributes:
        session: the session.
        what: the corrected field.
        value: its new value, as text; a start in ns.
        amended_ns: time of the correction, UTC; distinguishes equal corrections.
    """

    session: SessionId
    what: Amendable
    value: str
    amended_ns: int

    def applied(self, session: Session) -> Session:
        """The session with this amendment.

        Raises:
            ValueError: a start is not a number.
        """
        recorded = session.as_recorded
        if self.what is Amendable.ROBOT:
            return replace(session, robot=self.value, recorded=recorded)
        if self.what is Amendable.ZONE:
            return replace(session, zone=self.value, longitude_deg=None, recorded=recorded)
        shift_ns = int(self.value) - recorded.start_ns
        return replace(session, clock=Clock.UTC, shift_ns=shift_ns, recorded=recorded)


@dataclass(frozen=True, slots=True)
class Node:
    """A frame saved in a map. Never changes once written.

    Attributes:
        id: the same whenever this frame of this drive is saved (`node_id`).
        session: the drive that saved it.
        stamp_ns: stamp of its frame, ns.
        camera: camera of its frame.
        driven_m: odometry distance from the session's start to this node, metres.
    """

    id: NodeId
    session: SessionId
    stamp_ns: int
    camera: CameraId
    driven_m: float


class EdgeKind(StrEnum):
    """Origin of an edge (method §1, §3.1)."""

    ODOMETRY = "odometry"
    MATCH = "match"
    TIE = "tie"
    PROXIMITY = "proximity"
    BRIDGE = "bridge"


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A 6DoF transform between two nodes; usable in both directions.

    Attributes:
        a, b: its ends. The key of an edge is (a, b, kind); a newer one supersedes an older one.
        kind: its origin.
        a_from_b: pose of node b's camera in node a's camera frame.
        covariance: (6, 6) float64 of `a_from_b`, left perturbation, [translation, rotation].
    """

    a: NodeId
    b: NodeId
    kind: EdgeKind
    a_from_b: SE3
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Omission:
    """A node that a merge left out, as the map already shows its place alike (method §7).

    Attributes:
        omitted: the node that was left out.
        node: its equivalent in the map.
        node_from_omitted: pose of the omitted node's camera in the equivalent's camera frame.
        landmark_hash: 16-byte hash of its landmarks; None if not stored, as in maps of format 2.
    """

    omitted: NodeId
    node: NodeId
    node_from_omitted: SE3
    landmark_hash: bytes | None = None


class PathEntryKind(StrEnum):
    """Why a node is on a path."""

    MATCHED = "matched"
    SAVED = "saved"
    REPLAYED = "replayed"


@dataclass(frozen=True, slots=True)
class PathEntry:
    """One step of a session's walk through experience space; (path, sequence) is its key."""

    path: PathId
    sequence: int
    node: NodeId
    kind: PathEntryKind
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Attempt:
    """One remembered match attempt (method §3.5).

    Attributes:
        iteration: the localiser's iteration in this session.
        reference: node of the position that gave the prediction.
        node: the attempted node.
        along_m, across_m: predicted offset of the live camera from the node, along and across
            the node's viewing direction, metres.
        yaw_rad: predicted heading of the live camera relative to the node.
        sigma_m, sigma_yaw_rad: standard deviations of the prediction.
        accepted: whether the match was accepted.
        inliers: inliers of the match, 0 if there was none.
        rank: place in the ranked order, 0 first.
        policy: name of the ranking policy.
    """

    iteration: int
    reference: NodeId
    node: NodeId
    along_m: float
    across_m: float
    yaw_rad: float
    sigma_m: float
    sigma_yaw_rad: float
    accepted: bool
    inliers: int
    rank: int
    policy: str


class LandmarkSource(Protocol):
    """Where the frames of nodes come from; `engram.maps` implements it."""

    def frame(self, node: NodeId) -> Frame:
        """The frame that was saved as `node`. Safe to call from several threads.

        Raises:
            MapCorruptError: its bytes do not match their hash.
        """
        ...

    def prefetch(self, nodes: list[NodeId]) -> None:
        """Announces the nodes likely to be read next. Returns at once."""
        ...


def session_id(robot: str, camera: CameraId, start_ns: int, first_pair_hash: str) -> SessionId:
    """The same drive read twice gets the same UUID (method §2.7)."""
    name = f"session:{robot}:{camera}:{start_ns}:{first_pair_hash}"
    return SessionId(uuid5(ENGRAM_NAMESPACE, name))


@lru_cache(maxsize=1024)  # localisers of one drive ask for the same frame in turn
def node_id(session: SessionId, stamp_ns: int) -> NodeId:
    """The same frame of the same drive gets the same UUID (method §2.7)."""
    # `uuid5`, which takes four times as long: it imports hashlib each time.
    digest = sha1(session.bytes + f"node:{stamp_ns}".encode(), usedforsecurity=False).digest()
    return NodeId(UUID(bytes=digest[:16], version=5))


@lru_cache(maxsize=4096)  # policies ask for the paths of all sessions on every frame
def path_id(session: SessionId) -> PathId:
    """A session has one path through experience space."""
    return PathId(uuid5(session, "path"))


# Two measurements of one edge within this are the same measurement: a look-alike that is matched
# again gives its pose again to some centimetres, a true match of the same nodes lies elsewhere.
SAME_M, SAME_RAD = 1.0, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Removal:
    """An edge that no longer counts, though its record stays.

    Attributes:
        a, b, kind: its key; the order of the ends does not matter.
        a_from_b: what it measured. Another measurement between the same nodes counts.
        reason: the evidence, for people.
        removed_ns: time of the removal, UTC; distinguishes equal ones.
    """

    a: NodeId
    b: NodeId
    kind: EdgeKind
    a_from_b: SE3
    reason: str
    removed_ns: int

    @property
    def key(self) -> tuple[NodeId, NodeId, EdgeKind, int]:
        """Distinguishes removals, the order of ends included."""
        return self.a, self.b, self.kind, self.removed_ns


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a node lies in the map frame.

    Attributes:
        node: the node.
        map_from_node: pose of its camera in the map frame: x, y horizontal, z up, metres.
    """

    node: NodeId
    map_from_node: SE3


@dataclass(frozen=True, slots=True)
class Anchor:
    """A known position of a node in the map frame.

    Attributes:
        node: the node.
        x_m, y_m: its camera's position in the map frame, metres.
        z_m: its height, metres; None if unknown.
        sigma_m: standard deviation along each axis, metres.
        source: where it comes from, for people.
    """

    node: NodeId
    x_m: float
    y_m: float
    z_m: float | None
    sigma_m: float
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class Goal:
    """A named pose, stored relative to a node: it stays where it is when the frame moves.

    Attributes:
        name: its name; of goals of one name the newest counts.
        node: the node that it is stored in.
        node_from_goal: pose of a robot's camera that stands at the goal, in the node's camera.
    """

    name: str
    node: NodeId
    node_from_goal: SE3


Mark: TypeAlias = Removal | Placement | Anchor | Goal


class Removed:
    """Which edges were removed.

    Args:
        removals: in any order.
    """

    def __init__(self, removals: Iterable[Removal]) -> None:
        self._known: dict[tuple[frozenset[NodeId], EdgeKind], list[Removal]] = defaultdict(list)
        for one in removals:
            self._known[frozenset((one.a, one.b)), one.kind].append(one)

    def __bool__(self) -> bool:
        return bool(self._known)

    def __contains__(self, edge: Edge) -> bool:
        """Whether the edge is a removed one, or its measurement made again."""
        return any(
            same_measurement(
                one.a_from_b, edge.a_from_b if edge.a == one.a else edge.a_from_b.inverse()
            )
            for one in self._known.get((frozenset((edge.a, edge.b)), edge.kind), ())
        )


def same_measurement(removed: SE3, measured: SE3) -> bool:
    """Whether two transforms between the same nodes are one measurement."""
    apart = removed.inverse() @ measured
    return apart.distance_m <= SAME_M and apart.angle_rad <= SAME_RAD
