"""Pictures of maps, matches and trajectories."""

from engram.viewing.from_above import (
    Track,
    check_picture,
    draw_from_above,
    draw_panels,
)
from engram.viewing.matches import match_picture

__all__ = [
    "Track",
    "check_picture",
    "draw_from_above",
    "draw_panels",
    "match_picture",
]
