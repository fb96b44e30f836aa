"""Pictures."""

from engram.viewing.from_above import Track, draw_attempts, draw_from_above
from engram.viewing.matches import match_picture

__all__ = ["Track", "draw_attempts", "draw_from_above", "match_picture"]
