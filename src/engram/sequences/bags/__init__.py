"""ROS bags as drives: ROS 1, and ROS 2 in SQLite or MCAP."""

from engram.sequences.bags.bag import Bag, is_bag
from engram.sequences.bags.sequence import BagSequence, open_bag

__all__ = ["Bag", "BagSequence", "is_bag", "open_bag"]
