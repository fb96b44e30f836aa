"""Every instruction set computes the same bits: one seed, one ranking, on any machine."""

import hashlib
import os
import subprocess
import sys

import numpy as np

from engram import _core
from engram.geometry import SE3
from engram.graph.neighbourhood import Search
from engram.ranking.path import PathPolicy
from engram.ranking.recall import RecallPolicy
from engram_lab.bench.synthetic import SyntheticPlace

PRINT_DIGEST = """
from engram import _core
from tests.ranking.test_instruction_sets import digest
print(_core.isa, digest())
"""


def digest() -> str:
    """Of scores over long and short bitsets, and of a search over a random graph."""
    from tests.graph.test_graph import random_graph

    parts = []
    for path_count in (0, 1, 150, 300):
        context = SyntheticPlace(path_count).context()
        parts.append(RecallPolicy().judge(context).chances.tobytes())
        parts.append(PathPolicy().scores(context, context.neighbourhood.nodes).tobytes())
    near = random_graph(1).neighbourhood(5, SE3.identity(), 0.01 * np.eye(6), Search(12.0, 3.2))
    parts += [near.nodes.tobytes(), near.node_from_live.tobytes(), near.sigma_m.tobytes()]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def test_generic_and_best_give_the_same_bits() -> None:
    run = subprocess.run(
        [sys.executable, "-c", PRINT_DIGEST],
        env={**os.environ, "ENGRAM_ISA": "generic"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.split() == ["generic", digest()]
    assert _core.isa in {"generic", "v3", "v4"}
