"""Settings of the search for wrong edges."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from engram.config import check_bounds
from engram.graph.adjusting import AdjustConfig


@dataclass(frozen=True, slots=True)
class RepairConfig:
    """Settings of `find_wrong_edges`.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    adjust: AdjustConfig = field(default_factory=AdjustConfig)
    gross_m: Annotated[
        float,
        Meta(
            ge=0,
            description="disagreement with the rest of the map from which an edge is suspected, m; "
            "smaller errors do not lead a robot to another place",
        ),
    ] = 2.0
    gross_rad: Annotated[float, Meta(ge=0, description="the same of its direction, rad")] = 0.25
    gross_chi2: Annotated[
        float, Meta(gt=0, description="the same in squared standard deviations")
    ] = 50.0
    cycle_m: Annotated[
        float,
        Meta(
            gt=0,
            description="length of another path between its ends up to which agreement with that "
            "path confirms an edge, m: odometry drifts by less than `gross_m` over it",
        ),
    ] = 40.0
    looks: Annotated[
        int, Meta(ge=1, description="pairs of nodes that are matched to judge one edge, at most")
    ] = 16
    look_within_m: Annotated[
        float, Meta(gt=0, description="greatest path length from an edge's ends to such nodes, m")
    ] = 20.0
    look_apart_m: Annotated[
        float, Meta(gt=0, description="distance at which two nodes show enough of the same, m")
    ] = 4.0
    look_rad: Annotated[
        float, Meta(gt=0, description="angle at which two nodes show enough of the same, rad")
    ] = 0.5
    look_every_m: Annotated[
        float, Meta(gt=0, description="least distance between nodes of two pairs, m")
    ] = 1.5
    agree_m: Annotated[
        float, Meta(gt=0, description="distance within which a match confirms an edge, m")
    ] = 0.7
    agree_rad: Annotated[
        float, Meta(gt=0, description="angle within which a match confirms an edge, rad")
    ] = 0.1
    agree_inliers: Annotated[
        int, Meta(ge=0, description="fewest inliers of a match that confirms an edge")
    ] = 10
    odometry_inliers: Annotated[
        int,
        Meta(
            ge=0,
            description="inliers of a match of its own ends from which a step of odometry is right "
            "whatever contradicts it: more than look-alikes reach",
        ),
    ] = 60
    match_inliers: Annotated[int, Meta(ge=0, description="the same of a match or a tie")] = 100
    least_failing_looks: Annotated[
        int,
        Meta(
            ge=0,
            description="second looks that must disagree with a tie or a step of odometry that the "
            "rest of the map contradicts, before it is wrong",
        ),
    ] = 3
    most_unseen: Annotated[
        float, Meta(description="greatest surety of such an edge with fewer second looks")
    ] = 0.95
    contradicted_surety: Annotated[
        float,
        Meta(description="surety that an edge contradicted by the rest of the map is wrong"),
    ] = 1.8
    alone_surety: Annotated[float, Meta(description="surety that an unconfirmed edge is wrong")] = (
        0.85
    )
    tie_surety: Annotated[
        float,
        Meta(description="surety subtracted for a tie: a localised robot made it, and drove on"),
    ] = 0.5
    doubtful: Annotated[
        float, Meta(description="surety from which an edge is listed as doubtful")
    ] = 0.7
    per_failing_look: Annotated[
        float, Meta(ge=0, description="surety that each disagreeing second look adds")
    ] = 0.1
    most_by_looks: Annotated[
        float, Meta(ge=0, description="greatest surety that such looks add together")
    ] = 0.8
    per_look: Annotated[
        float, Meta(ge=0, description="surety that each agreeing second look subtracts")
    ] = 0.15
    per_fix: Annotated[
        float,
        Meta(
            ge=0,
            description="surety that each fix of a drive across the edge subtracts, of five at "
            "most",
        ),
    ] = 0.2

    def __post_init__(self) -> None:
        check_bounds(self)
