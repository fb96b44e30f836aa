"""The laboratory's verbs, which join the program by entry points."""

from engram_lab.cli.benchmark import bench
from engram_lab.cli.demonstration import demo
from engram_lab.cli.evaluation import evaluate
from engram_lab.cli.places import places, relocalise
from engram_lab.cli.simulation import simulate
from engram_lab.cli.trying import try_

__all__ = ["bench", "demo", "evaluate", "places", "relocalise", "simulate", "try_"]
