"""Downloads: what one mission needs of the fleet map."""

from engram.fleet.download.downloading import download

__all__ = ["download"]
