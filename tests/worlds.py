"""Edges, poses and attempts for tests of small experience graphs."""

import numpy as np

from engram.geometry.se3 import SE3
from engram.graph.model import Attempt, Edge, EdgeKind, NodeId, SessionId
from engram.maps.records import MapContents


def covariance_of(sigma_m: float, sigma_rad: float) -> np.ndarray:
    return np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)


def make_edge(a: NodeId, b: NodeId, a_from_b: SE3, kind=EdgeKind.ODOMETRY, sigma=(0.02, 0.001)):
    return Edge(a, b, kind, a_from_b, covariance_of(*sigma))


def forward(metres: float, across_m: float = 0.0, yaw_rad: float = 0.0) -> SE3:
    """A pose ahead, to the right, and turned to the right."""
    turn = SE3.exp([0, 0, 0, 0, yaw_rad, 0])
    return SE3(turn.rotation, np.array([across_m, 0.0, metres]))


def attempts_of(contents: MapContents, session: SessionId) -> list[Attempt]:
    """The remembered attempts of one session as records."""
    made = contents.attempts
    place = next((at for at, one in enumerate(contents.sessions) if one.id == session), -1)
    return [
        Attempt(
            iteration=int(made.iteration[row]),
            reference=contents.nodes[made.reference[row]].id,
            node=contents.nodes[made.node[row]].id,
            along_m=float(made.along_m[row]),
            across_m=float(made.across_m[row]),
            yaw_rad=float(made.yaw_rad[row]),
            sigma_m=float(made.sigma_m[row]),
            sigma_yaw_rad=float(made.sigma_yaw_rad[row]),
            accepted=bool(made.accepted[row]),
            inliers=int(made.inliers[row]),
            rank=int(made.rank[row]),
            policy=made.policies[made.policy[row]],
        )
        for row in np.flatnonzero(made.session == place)
    ]
