"""The plain pipeline that stages are timed beside, where PoseLib is at hand."""

from __future__ import annotations

import importlib.util
from types import ModuleType
from typing import TypeAlias

PlainPipeline: TypeAlias = ModuleType


def load_plain_pipeline() -> tuple[PlainPipeline | None, str]:
    """The module and "", or None and the reason why there is no reference."""
    if importlib.util.find_spec("poselib") is None:
        return None, "no reference: PoseLib is not installed (pip install poselib)"
    from engram_lab.bench import reference

    return reference, ""
