"""The nodes near the robot, as seen from it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from engram.graph.chain_error import PivotedError


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
