"""Results of localisation, and what keeps them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import ConfigError
from engram.frontend.frame import Frame
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.odometry.motion import UNMOVED, Motion


@dataclass(frozen=True, slots=True)
class Budget:
    """How much matching one live frame may cost (method §1: Np × Nr).

    Attributes:
        lanes: Np, attempts that run at the same time, each on its own thread.
        rounds: Nr, how often that many attempts start for one frame.
        lost_rounds: the same for a lost robot. Larger, because place recognition only
            proposes where it may be.
        deadline_ms: latest start of an attempt after the frame arrived; None for no limit. At
            most one attempt per lane overruns it.
    """

    lanes: int = 2
    rounds: int = 2
    lost_rounds: int = 32
    deadline_ms: float | None = None

    def __post_init__(self) -> None:
        for name in ("lanes", "rounds", "lost_rounds"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ConfigError(f"budget: {name} is {value}, must be a whole number, at least 1")
        if self.deadline_ms is not None and not self.deadline_ms > 0:
            raise ConfigError(f"budget: deadline_ms is {self.deadline_ms}, must be > 0")

    @property
    def attempts(self) -> int:
        """The most attempts for one frame."""
        return self.lanes * self.rounds

    @property
    def lost_attempts(self) -> int:
        """The most attempts for one frame of a lost robot."""
        return self.lanes * max(self.rounds, self.lost_rounds)


class LocalisationStatus(StrEnum):
    """State of the robot after one frame (method §3)."""

    LOCALISED = "localised"
    DEAD_RECKONING = "dead_reckoning"
    LOST = "lost"
    NO_ODOMETRY = "no_odometry"


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """Where the live camera is, seen from a node (method §1: ``(k, T_k_q)``).

    Attributes:
        node: the reference node.
        node_from_live: pose of the live camera in that node's camera.
        covariance: (6, 6) float64 of `node_from_live`, left perturbation,
            [translation, rotation].
    """

    node: NodeId
    node_from_live: SE3
    covariance: NDArray[np.float64]

    @staticmethod
    def at(node: NodeId) -> Position:
        """The position of the frame that was saved as `node`."""
        return Position(node, SE3.identity(), np.zeros((6, 6)))

    @staticmethod
    def mounted(
        node: NodeId,
        node_camera: StereoCamera,
        live_camera: StereoCamera,
        covariance: NDArray[np.float64],
    ) -> Position:
        """Position of a robot standing where the node was recorded.

        The cameras of the two may be mounted at other heights, sides and angles. Without known
        mountings both cameras count as mounted alike.

        Args:
            node: the reference node.
            node_camera, live_camera: of the node's frame and of the robot.
            covariance: (6, 6) float64 of the pose, left perturbation, [translation, rotation].
        """
        mountings = node_camera.cam_from_rig, live_camera.cam_from_rig
        if mountings[0] is None or mountings[1] is None:
            return Position(node, SE3.identity(), covariance)
        return Position(node, mountings[0] @ mountings[1].inverse(), covariance)

    def carried_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> Position:
        """The position after one more step of odometry with its (6, 6) covariance."""
        return Position(
            self.node, *self.node_from_live.chain(self.covariance, prev_from_curr, covariance)
        )

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position along its least certain axis, metres."""
        return _core.greatest_sigma(self.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """The result for one live frame. Not localising is a result too.

    Attributes:
        stamp_ns: stamp of the live frame, UTC.
        status: whether the frame was matched, and if not, what is known.
        node: the matched node; None unless `LOCALISED`.
        node_stamp_ns: stamp of that node.
        node_from_live: pose of the live camera in it, by the match and, if that is weak, by those
            before it that led to expect it; None unless `LOCALISED`.
        covariance: (6, 6) float64 of `node_from_live`, left perturbation, [translation, rotation].
        inliers: landmarks that agree with the pose, 0 unless `LOCALISED`.
        confidence: log-odds that the match is right; of the best attempt if none was accepted,
            -inf if none had a pose.
        attempts: match attempts made for this frame.
        proposed: attempts without a prediction, at nodes proposed to a lost robot. They draw
            fewer samples (`LocaliserConfig.lost_max_samples`).
        candidates: nodes in reach that could have been attempted.
        open_loop_m: distance driven on odometry alone since the last match, metres.
        motion: motion since the previous usable frame, as far as it is known.
        position: the best estimate, as above or carried on by odometry; None while `LOST` with
            no estimate.
        measured: the same by the last match alone, on which edges of a map rest.
        looked_up: whether place recognition ran for this frame.
        damaged: candidates whose landmarks cannot be read, each reported once; the localiser skips
            them from then on. ``engram check`` gives details.
        withdraws: stamps of earlier fixes that this one contradicts and that are withdrawn.
        saved: the node that the frame was saved as, if the robot maps.
        resumed: whether an interrupted run had processed this frame: no attempt was made, only the
            motion counts.
        late: whether the result came after the deadline.
        fixed_share: share of the image that the robot has learnt moves with its camera, and leaves
            out.
        stage_ms: duration of each stage; "places" only if place recognition ran.
    """

    stamp_ns: int
    status: LocalisationStatus
    attempts: int
    candidates: int
    open_loop_m: float
    motion: Motion = UNMOVED
    proposed: int = 0
    node: NodeId | None = None
    node_stamp_ns: int | None = None
    node_from_live: SE3 | None = None
    covariance: NDArray[np.float64] | None = None
    inliers: int = 0
    confidence: float = -math.inf
    position: Position | None = None
    measured: Position | None = None
    looked_up: bool = False
    damaged: tuple[NodeId, ...] = ()
    withdraws: tuple[int, ...] = ()
    saved: NodeId | None = None
    resumed: bool = False
    late: bool = False
    fixed_share: float = 0.0
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def localised(self) -> bool:
        """Whether the frame was matched with the map."""
        return self.status is LocalisationStatus.LOCALISED

    @property
    def ms(self) -> float:
        """Duration of all stages together."""
        return sum(self.stage_ms.values())

    def to_dict(self) -> dict[str, Any]:
        """The record that ``localise --json`` prints for a frame."""
        pose = self.node_from_live
        return {
            "stamp_ns": self.stamp_ns,
            "status": self.status.value,
            "node": None if self.node is None else str(self.node),
            "node_stamp_ns": self.node_stamp_ns,
            "node_from_live": None if pose is None else pose.matrix().ravel().tolist(),
            "inliers": self.inliers,
            "confidence": self.confidence if math.isfinite(self.confidence) else None,
            "attempts": self.attempts,
            "candidates": self.candidates,
            "open_loop_m": self.open_loop_m,
            "withdraws": list(self.withdraws),
            "damaged": [str(node) for node in self.damaged],
            "fixed_share": self.fixed_share,
            "ms": self.ms,
        }


class StageClock:
    """Splits the time of one frame into stages.

    Args:
        started: `time.perf_counter` when its images arrived; None for now.
    """

    def __init__(self, started: float | None = None) -> None:
        self._last = perf_counter()
        self.started = self._last if started is None else started
        self.stage_ms: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """Ends a stage, and records its duration under its name."""
        now = perf_counter()
        self.stage_ms[stage] = (now - self._last) * 1e3
        self._last = now


@dataclass(frozen=True, slots=True, eq=False)
class Hint:
    """What a result sink contributes about a frame before it is localised.

    Attributes:
        position: where the robot is; None leaves it to the localiser.
        open_loop_m: distance driven since the last match with the map, metres; None keeps the
            localiser's own count.
        guessed_m: standard deviation of the motion guessed since then, metres; infinite if the
            robot is only roughly known and must be found again.
        agreed: number of fixes that confirm the position; 0 if only the caller supplied it.
        found: an earlier result for this frame, which is then not localised again.
    """

    position: Position | None = None
    open_loop_m: float | None = 0.0
    guessed_m: float = 0.0
    agreed: int = 0
    found: Localisation | None = None


class ResultSink:
    """Keeps the results of a robot. This base class keeps nothing.

    For each frame the robot calls `hint`, then `keep`. It may later withdraw a match: it calls
    `withdrawn` with the result of `keep`. A result sink holds back whatever a withdrawal would undo
    until a withdrawal is no longer possible.
    """

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """The result sink's contribution before the frame is localised; `motion` led to it."""
        del live, motion
        return None

    def may_propose(self) -> bool:
        """Whether to try places all over the map."""
        return True

    def may_propose_own(self) -> bool:
        """The same for nodes that the session itself saved."""
        return True

    def alone_m(self) -> float:
        """Distance driven since the nodes being saved lost their connection to the map, metres.

        0 while connected.
        """
        return 0.0

    def keep(self, live: Frame, result: Localisation) -> Localisation:
        """Keeps the result for a frame; returns it, completed by what was stored."""
        del live
        return result

    def withdrawn(self, result: Localisation) -> None:
        """A later frame disproved the match: treat the frame as not localised."""

    def finish(self) -> None:
        """The drive is over."""


NO_SINK = ResultSink()
