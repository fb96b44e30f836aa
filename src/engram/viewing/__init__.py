"""Pictures."""

from engram.viewing.matches import match_picture

__all__ = ["match_picture"]
