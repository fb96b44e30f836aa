"""OpenCV's contrib modules, which only some of its wheels have; Engram's defaults need none."""

from __future__ import annotations

from typing import Any

import cv2

from engram.errors import MissingExtraError


def xfeatures2d(user: str) -> Any:
    """OpenCV's module of that name; its stubs leave it out.

    All OpenCV wheels install into one folder, and the last one wins: that a wheel with the module
    is installed does not mean that `cv2` has it.

    Args:
        user: what needs it, the subject of the error's sentence.
    """
    module = getattr(cv2, "xfeatures2d", None)
    if not hasattr(module, "TEBLID_create"):
        raise MissingExtraError(
            f"{user} needs cv2.xfeatures2d, which the installed OpenCV {cv2.__version__} does not "
            "have: pip install --force-reinstall --no-deps opencv-contrib-python-headless"
        )
    return module
