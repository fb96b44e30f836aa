"""The nodes near the robot, with its predicted pose in each."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.graph.basin import PivotedError
from engram.graph.model import SessionId


@dataclass(frozen=True, slots=True)
class SearchConfig:
    """Extent of the neighbourhood search (method §3.1).

    A node predicted just outside may lie inside: the slack extends radius, gate and search.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    margin_m: Annotated[
        float,
        Meta(
            ge=0,
            description="distance beyond the radius that chains may lead and come back, m: room "
            "for the corner of a block or a turning loop",
        ),
    ] = 12.0
    slack_sigmas: Annotated[
        float,
        Meta(
            ge=0,
            description="standard deviations of a prediction by which radius and gate are "
            "extended; 2 keep 95 % of the nodes within them",
        ),
    ] = 2.0
    slack_m: Annotated[
        float,
        Meta(
            ge=0,
            description="upper limit of that extension, m: beyond it a node's position is unknown, "
            "and searching for it costs too much",
        ),
    ] = 30.0
    vague_m: Annotated[
        float,
        Meta(
            ge=0,
            description="standard deviation of a chain above which the search looks for a better "
            "one, m: that of a gap of odometry. 0.5 and 2 give nearly the same nodes",
        ),
    ] = 1.0
    detour_m: Annotated[
        float,
        Meta(
            ge=0,
            description="additional distance that the better chain may lead out, m: a block of "
            "houses. Above 30 few nodes change, and the search gets slower",
        ),
    ] = 60.0

    def __post_init__(self) -> None:
        check_bounds(self)


DEFAULT_SEARCH = SearchConfig()


@dataclass(frozen=True, slots=True)
class Search:
    """Which nodes of an experience graph count as near (method §3.1).

    Attributes:
        radius_m: largest predicted distance of a node.
        view_gate_rad: largest difference of heading (yaw alone, method §2.6).
        own_session: the live session; its nodes saved within the last `own_exclusion_m` before
            `own_driven_m` do not count, but chains may lead through them.
        own_driven_m: distance driven by the live session, metres.
        own_exclusion_m: see `own_session`.
        config: extent of the search.
    """

    radius_m: float
    view_gate_rad: float
    own_session: SessionId | None = None
    own_driven_m: float = 0.0
    own_exclusion_m: float = 30.0
    config: SearchConfig = DEFAULT_SEARCH


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Candidate nodes Y of one live frame (method §3.1): a struct of arrays, one row per candidate.

    Rows are in the order of the search: least uncertain first.

    Attributes:
        nodes: (Y,) int32, dense indices into the `ExperienceGraph`.
        node_from_live: (Y, 4, 4) float64, homogeneous, m: predicted pose of the live camera in
            each node.
        distance_m: (Y,) float64, norm of the predicted translation.
        along_m, across_m: (Y,) float64, offset of the live camera from the node along and across
            the node's viewing direction.
        yaw_rad: (Y,) float64, heading of the live camera relative to the node, in (-π, π].
        sigma_m, sigma_yaw_rad: (Y,) float64, standard deviations of the prediction along the
            worst axis.
        pivot_in_node: (Y, 3) float64, metres, centre of the prediction's rotation error
            (`chain_error`).
    """

    nodes: NDArray[np.int32]
    node_from_live: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    along_m: NDArray[np.float64]
    across_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    sigma_yaw_rad: NDArray[np.float64]
    pivot_in_node: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def rms_distance_m(self) -> NDArray[np.float64]:
        """(Y,) float64: root mean square of the distance under its uncertainty, metres."""
        return np.asarray(np.hypot(self.distance_m, self.sigma_m))

    def rows(self, rows: NDArray[np.intp]) -> Neighbourhood:
        """The candidates at (K,) row numbers, in this order."""
        return Neighbourhood(*(getattr(self, field.name)[rows] for field in fields(self)))

    def covariance(self, row: int) -> NDArray[np.float64]:
        """(6, 6) covariance of `node_from_live[row]`, left perturbation, [translation, rotation].

        Its translational variance at the live camera is `sigma_m` squared.
        """
        lever = self.node_from_live[row, :3, 3] - self.pivot_in_node[row]
        rotation_var = float(self.sigma_yaw_rad[row]) ** 2
        translation_var = float(self.sigma_m[row]) ** 2 - rotation_var * float(lever @ lever)
        return PivotedError(
            max(translation_var, 0.0), rotation_var, self.pivot_in_node[row]
        ).covariance()
