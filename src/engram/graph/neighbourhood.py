"""The nodes near the robot, as seen from it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.graph.chain_error import PivotedError
from engram.graph.model import SessionId


@dataclass(frozen=True, slots=True)
class SearchConfig:
    """How far a search for what is near goes out (SPEC §3.1).

    A node just outside may truly lie inside: hence the slack, which extends the search, too.

    Raises:
        ConfigError: one is out of its bounds.
    """

    margin_m: Annotated[
        float,
        Meta(
            ge=0,
            description="how far beyond the radius chains may lead and come back, m: a block's "
            "corner or a turning loop fits in",
        ),
    ] = 12.0
    slack_sigmas: Annotated[
        float,
        Meta(
            ge=0,
            description="by how many standard deviations of a prediction radius and gate are "
            "extended; 2 keep 95 % of the nodes that are truly near",
        ),
    ] = 2.0
    slack_m: Annotated[
        float,
        Meta(
            ge=0,
            description="by how much at most, m: beyond it the map does not know where a node is, "
            "and looking for it there costs too much",
        ),
    ] = 30.0
    vague_m: Annotated[
        float,
        Meta(
            ge=0,
            description="standard deviation of a chain past which a better one is looked for, m: "
            "those through a gap of odometry. 0.5 and 2 give nearly the same nodes",
        ),
    ] = 1.0
    detour_m: Annotated[
        float,
        Meta(
            ge=0,
            description="how much further out the better chain may lead, m: a block of houses. "
            "From 30 on nodes change by an eighth at most, and the search gets slower",
        ),
    ] = 60.0

    def __post_init__(self) -> None:
        check_bounds(self)


DEFAULT_SEARCH = SearchConfig()


@dataclass(frozen=True, slots=True)
class Search:
    """What of an experience graph is near (SPEC §3.1).

    Attributes:
        radius_m: a node is near if its predicted distance is at most this,
        view_gate_rad: and its heading differs by at most this (yaw alone, SPEC §2.6).
        own_session: the live session; its nodes saved within the last `own_exclusion_m` before
            `own_driven_m` are not near (but are gone through).
        own_driven_m: metres driven by the live session.
        own_exclusion_m: see above.
        config: how far the search goes out.
    """

    radius_m: float
    view_gate_rad: float
    own_session: SessionId | None = None
    own_driven_m: float = 0.0
    own_exclusion_m: float = 30.0
    config: SearchConfig = DEFAULT_SEARCH


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Candidate nodes Y of one live frame (SPEC §3.1): a struct of arrays, one row per candidate.

    Rows stand in the order in which the search found them: least uncertain first.

    Attributes:
        nodes: (Y,) int32, dense indices into the `ExperienceGraph`.
        node_from_live: (Y, 4, 4) float64, predicted pose of the live camera in each node.
        distance_m: (Y,) float64, norm of the predicted translation.
        along_m, across_m: (Y,) float64, offset of the live camera from the node along and across
            the node's viewing direction.
        yaw_rad: (Y,) float64, heading of the live camera relative to the node, in (-π, π].
        sigma_m, sigma_yaw_rad: (Y,) float64, standard deviations of the prediction along the
            worst axis.
        pivot_in_node: (Y, 3) float64, the point about which the prediction's rotation error
            turns (`chain_error`).
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
        """(Y,) root mean square of the distance, metres: it may be longer than predicted."""
        return np.asarray(np.hypot(self.distance_m, self.sigma_m))

    def rows(self, rows: NDArray[np.intp]) -> Neighbourhood:
        """Some of the candidates, in the order of `rows`."""
        return Neighbourhood(*(getattr(self, field.name)[rows] for field in fields(self)))

    def covariance(self, row: int) -> NDArray[np.float64]:
        """(6, 6) covariance of `node_from_live[row]`, left perturbation, [translation, rotation].

        At the live camera it gives a translational variance of `sigma_m` squared.
        """
        lever = self.node_from_live[row, :3, 3] - self.pivot_in_node[row]
        rotation_var = float(self.sigma_yaw_rad[row]) ** 2
        translation_var = float(self.sigma_m[row]) ** 2 - rotation_var * float(lever @ lever)
        return PivotedError(
            max(translation_var, 0.0), rotation_var, self.pivot_in_node[row]
        ).covariance()
