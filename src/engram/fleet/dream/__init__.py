"""Dreaming: between forays the centre looks for a better map in what robots handed in."""

from engram.fleet.dream.dreaming import FEWEST_DRIVES, DreamOptions, DreamReport, dream
from engram.fleet.dream.hand_ins import hand_ins_of, keep_hand_in

__all__ = ["FEWEST_DRIVES", "DreamOptions", "DreamReport", "dream", "hand_ins_of", "keep_hand_in"]
