"""Unpacks compressed chunks, messages and files, never to more than they may hold."""

from __future__ import annotations

import bz2
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from engram.errors import MissingExtraError, SequenceError
from engram.sequences.bags.records import MAX_BYTES, DamageError
from engram.untrusted import open_regular

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
ENDINGS = (".zstd", ".zst")
# A file that grows more is no recording: images with the noise of a sensor shrink to a tenth.
_MOST_RATIO = 200
_BLOCK = 4_000_000


def needs_bags(error: ImportError) -> MissingExtraError:
    """The error to raise if a package of the extra `bags` is not installed."""
    return MissingExtraError(
        f"reading ROS bags needs {error.name or 'rosbags'}: pip install 'engram-localisation[bags]'"
    )


def unpacked(data: bytes, kind: str, size: int | None = None, *, whole: bool = True) -> bytes:
    """The content of a compressed block.

    Args:
        data: the block.
        kind: "none" or "", "bz2", "lz4" (frames), "zstd".
        size: its stated size; None if it states none.
        whole: whether all of it is there; of a part, what unpacks is returned.

    Raises:
        DamageError: it is damaged, of an unknown kind, or not of the stated size.
        MissingExtraError: the extra `bags` is not installed.
    """
    most = MAX_BYTES if size is None else size
    if most > MAX_BYTES:
        raise DamageError(f"claims to unpack to {most:,} bytes, at most {MAX_BYTES:,} are read")
    if kind in {"", "none"}:
        content = data
    else:
        unpacker = _unpacker(kind)
        try:
            content = unpacker.decompress(data, max_length=most + 1)
        except Exception as error:  # each library has errors of its own
            raise DamageError(f"its {kind} data are damaged") from error
    if len(content) > most or (whole and size is not None and len(content) != size):
        raise DamageError(f"unpacks to {len(content):,} bytes or more, not to {most:,}")
    return content


def _unpacker(kind: str) -> Any:
    try:
        if kind == "bz2":
            return bz2.BZ2Decompressor()
        if kind == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return LZ4FrameDecompressor()
        if kind == "zstd":
            return _zstd().ZstdDecompressor()
    except ImportError as error:
        raise needs_bags(error) from error
    raise DamageError(f"is compressed as {kind[:20]!r}; known: bz2, lz4, zstd")


def _zstd() -> Any:
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


def unpack_file(path: Path, folder: TemporaryDirectory[str]) -> Path:
    """Unpacks NAME.mcap.zstd into a folder; returns the path of NAME.mcap there.

    Raises:
        SequenceError: it is damaged, or unpacks to more than a recording can.
        MissingExtraError: the extra `bags` is not installed.
    """
    out = Path(folder.name) / path.stem
    try:
        zstd = _zstd()
    except ImportError as error:
        raise needs_bags(error) from error
    with os.fdopen(open_regular(path), "rb") as packed, out.open("wb") as file:
        most = _MOST_RATIO * max(os.fstat(packed.fileno()).st_size, 100_000)
        try:
            with zstd.open(packed, "rb") as content:
                while block := content.read(_BLOCK):
                    if file.tell() + len(block) > most:
                        raise SequenceError(
                            f"{path}: unpacks to more than {_MOST_RATIO} times its size: it is "
                            "not a recording"
                        )
                    file.write(block)
        except (zstd.ZstdError, EOFError) as error:
            if not file.tell():
                raise SequenceError(f"{path}: is not a zstd file: {error}") from error
        except OSError as error:
            raise SequenceError(
                f"{path}: cannot be unpacked to {out.parent}: {error.strerror}; set TMPDIR to a "
                "folder with more space"
            ) from error
    return out
