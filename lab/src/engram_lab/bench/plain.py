"""The plain pipeline that stages are timed against, where its libraries are at hand."""

from __future__ import annotations

import importlib.util
from types import ModuleType
from typing import TypeAlias

from engram.errors import MissingExtraError
from engram.frontend.opencv_contrib import xfeatures2d

PlainPipeline: TypeAlias = ModuleType


def load_plain_pipeline() -> tuple[PlainPipeline | None, str]:
    """The module and "", or None and the reason why there is no reference."""
    if importlib.util.find_spec("poselib") is None:
        return None, "no reference: PoseLib is not installed (pip install poselib)"
    try:
        xfeatures2d("the plain pipeline")
    except MissingExtraError as error:
        return None, f"no reference: {error}"
    from engram_lab.bench import reference

    return reference, ""
