"""Every instruction set computes the same bits: one seed, one ranking, on any machine."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from tests.instruction_sets import printed

from engram.geometry.se3 import SE3
from engram.graph.neighbourhood import Search
from engram.ranking.policies import PathPolicy
from engram.ranking.recall import RecallPolicy
from engram_lab.bench.synthetic import SyntheticPlace

PRINT_DIGEST = """
import sys
sys.path.insert(0, sys.argv[1])
from tests.ranking.test_instruction_sets import digest
print(digest())
"""


def digest() -> str:
    """Of scores over long and short bitsets, and of a search over a random graph."""
    from tests.graph.test_graph import random_graph

    parts = []
    for path_count in (0, 1, 150, 300):
        context = SyntheticPlace(path_count).context()
        # NumPy's `exp`, and its `hypot` of two sides, differ in the last bit between processors.
        sure = replace(context.neighbourhood, sigma_m=np.zeros(len(context.neighbourhood.nodes)))
        judged = RecallPolicy().judge(replace(context, neighbourhood=sure))
        parts += [part.tobytes() for part in (judged.order, *judged.terms.values())]
        parts.append(PathPolicy().scores(context, context.neighbourhood.nodes).tobytes())
    near = random_graph(1).neighbourhood(5, SE3.identity(), 0.01 * np.eye(6), Search(12.0, 3.2))
    parts += [near.nodes.tobytes(), near.node_from_live.tobytes(), near.sigma_m.tobytes()]
    return hashlib.sha256(b"".join(parts)).hexdigest()


@pytest.mark.long
def test_every_instruction_set_gives_the_same_ranking() -> None:
    assert len(printed(PRINT_DIGEST)) == 1
