"""Downloads: what one mission needs of the fleet map."""

from engram.fleet.download.downloading import DownloadReport, download
from engram.fleet.download.mission import DownloadOptions, budget_from_text, hour_from_text
from engram.fleet.download.selections import SELECTIONS
from engram.fleet.download.updating import UpdateReport, update

__all__ = [
    "SELECTIONS",
    "DownloadOptions",
    "DownloadReport",
    "UpdateReport",
    "budget_from_text",
    "download",
    "hour_from_text",
    "update",
]
