"""Maps on the wire: pages of rows and blobs, each named by its SHA-256."""

from engram.transfers.bundles import Unbundler, bundle
from engram.transfers.join import MissingPartError, join
from engram.transfers.manifest import Manifest, WireManifest
from engram.transfers.pages import MAX_PART_BYTES, PartHash, part_hash
from engram.transfers.split import Split, split

__all__ = [
    "MAX_PART_BYTES",
    "Manifest",
    "MissingPartError",
    "PartHash",
    "Split",
    "Unbundler",
    "WireManifest",
    "bundle",
    "join",
    "part_hash",
    "split",
]
