"""Whether this OpenCV has its contrib modules; `make test-opencv` tries wheels with and without."""

from __future__ import annotations

import pytest

from engram.errors import MissingExtraError
from engram_lab.opencv_contrib import xfeatures2d


def _why_not() -> str:
    try:
        xfeatures2d("the test")
    except MissingExtraError as error:
        return str(error)
    return ""


needs_contrib = pytest.mark.skipif(bool(_why_not()), reason=_why_not())
