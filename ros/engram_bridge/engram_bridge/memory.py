"""How this process gets memory for images."""

from __future__ import annotations

import ctypes

# glibc's malloc.h: from how many bytes a block is mapped anew, and how many stay at hand.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST_BLOCK, _AT_HAND = 32 << 20, 256 << 20


def keep_memory() -> bool:
    """Lets the C library keep the memory of images for the next ones; False if it cannot.

    Otherwise each image is mapped anew: half of what taking it costs is the kernel's then, which
    clears its pages.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another C library than glibc
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST_BLOCK)) and bool(
        mallopt(_M_TRIM_THRESHOLD, _AT_HAND)
    )
