"""Baselines that Engram's ranking policies are measured against, each in one file.

They join `engram.ranking` by the entry points "engram.policies", as anybody's policy can.
"""

from engram_lab.policies.bag_of_words import BagOfWordsPolicy
from engram_lab.policies.bandit import BanditPolicy
from engram_lab.policies.collaborative import CollaborativePolicy
from engram_lab.policies.nearest_of_each import NearestOfEachPolicy
from engram_lab.policies.oracle import OraclePolicy
from engram_lab.policies.random import RandomPolicy
from engram_lab.policies.time_of_day import TimeOfDayPolicy

# What the studies run unless told, in the order of their tables.
STUDIED = (
    "distance",
    "path-near",
    "path",
    RandomPolicy.name,
    OraclePolicy.name,
    TimeOfDayPolicy.name,
    BagOfWordsPolicy.name,
    CollaborativePolicy.name,
    NearestOfEachPolicy.name,
    BanditPolicy.name,
    "recall",
)

__all__ = [
    "STUDIED",
    "BagOfWordsPolicy",
    "BanditPolicy",
    "CollaborativePolicy",
    "NearestOfEachPolicy",
    "OraclePolicy",
    "RandomPolicy",
    "TimeOfDayPolicy",
]
