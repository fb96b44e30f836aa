"""Ranking by path memory on a synthetic map."""

from __future__ import annotations

from uuid import UUID

import numpy as np

from engram.bench.data import BenchData
from engram.bench.plain import PlainPipeline
from engram.bench.stage import Prepared
from engram.experience.basin import MatchBasin
from engram.experience.graph import ExperienceGraph
from engram.experience.model import Node, NodeId, PathEntry, PathEntryKind, PathId, SessionId
from engram.experience.neighbourhood import Neighbourhood
from engram.experience.path_memory import PathMemory
from engram.geometry import CameraId
from engram.ranking import Observations, RankingContext, policy_named

_CANDIDATES, _OBSERVED, _NODES_ON_PATH = 200, 1000, 60


def prepare_ranking(data: BenchData, plain: PlainPipeline | None, *, paths: int) -> Prepared:
    """Order 200 candidates by Γ(path-literal) with 1,000 recent attempts over `paths` paths.

    Every path holds 60 of the 1,200 nodes, drawn with a fixed seed. There is no plain reference:
    the figure stands beside the paper's 0.5 ms.
    """
    del data, plain
    rng = np.random.default_rng(paths)
    count = _CANDIDATES + _OBSERVED
    graph = ExperienceGraph()
    session = SessionId(UUID(int=1))
    for number in range(count):
        node = NodeId(UUID(bytes=rng.bytes(16)))
        graph.add_node(Node(node, session, number, CameraId("0" * 32), float(number)))
    memory = PathMemory(graph)
    ids = graph.node_ids(np.arange(count, dtype=np.int32))
    for number in range(paths):
        path = PathId(UUID(int=number + 2))
        for sequence, at in enumerate(rng.choice(count, _NODES_ON_PATH, replace=False)):
            memory.add(PathEntry(path, sequence, ids[at], PathEntryKind.MATCHED, sequence))
    observations = Observations(
        np.arange(_CANDIDATES, count, dtype=np.int32), rng.random(_OBSERVED) < 0.7
    )
    context = RankingContext(
        neighbourhood=_neighbourhood(rng),
        graph=graph,
        path_memory=memory,
        basin=MatchBasin.of(500.0),
        observations=observations,
        reference=count - 1,
        own_path=None,
        stamp_ns=0,
    )
    policy = policy_named("path-literal")

    def ours(_: int) -> dict[str, int]:
        order = policy.rank(context)
        return {"paths": paths, "candidates": len(order), "observed": _OBSERVED}

    return Prepared(ours)


def _neighbourhood(rng: np.random.Generator) -> Neighbourhood:
    along_m, across_m = rng.uniform(-5, 5, (2, _CANDIDATES))
    poses = np.tile(np.eye(4), (_CANDIDATES, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = across_m, along_m
    return Neighbourhood(
        nodes=np.arange(_CANDIDATES, dtype=np.int32),
        node_from_live=poses,
        distance_m=np.hypot(along_m, across_m),
        along_m=along_m,
        across_m=across_m,
        yaw_rad=np.zeros(_CANDIDATES),
        sigma_m=np.full(_CANDIDATES, 0.1),
        sigma_yaw_rad=np.full(_CANDIDATES, 0.01),
        pivot_in_node=np.zeros((_CANDIDATES, 3)),
    )
