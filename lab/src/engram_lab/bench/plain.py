"""The plain pipeline of `benchmarks/reference.py`, where a checkout and PoseLib are at hand."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

# What the file offers is known by its own documentation; it is no part of the package.
PlainPipeline = Any

_NAME = "engram_benchmark_reference"


def load_plain_pipeline() -> tuple[PlainPipeline | None, str]:
    """The module and "", or None and the reason why there is no reference."""
    path = Path(__file__).parents[3] / "benchmarks" / "reference.py"
    if not path.is_file():
        return None, "no reference: benchmarks/reference.py comes with a checkout only"
    if importlib.util.find_spec("poselib") is None:
        return None, "no reference: PoseLib is not installed (pip install poselib)"
    if _NAME in sys.modules:
        return sys.modules[_NAME], ""
    spec = importlib.util.spec_from_file_location(_NAME, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[_NAME] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module, ""
