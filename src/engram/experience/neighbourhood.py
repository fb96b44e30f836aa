"""The nodes near the robot, as seen from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Candidate nodes Y of one live frame (SPEC §3.1): a struct of arrays, one row per candidate.

    Attributes:
        nodes: (Y,) int32, dense indices into the `ExperienceGraph`.
        node_from_live: (Y, 4, 4) float64, predicted pose of the live camera in each node.
        distance_m: (Y,) float64, norm of the predicted translation.
        along_m, across_m: (Y,) float64, offset of the live camera from the node along and across
            the node's viewing direction.
        yaw_rad: (Y,) float64, heading of the live camera relative to the node, in (-π, π].
        sigma_m, sigma_yaw_rad: (Y,) float64, standard deviations of the prediction.
    """

    nodes: NDArray[np.int32]
    node_from_live: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    along_m: NDArray[np.float64]
    across_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    sigma_yaw_rad: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.nodes)
