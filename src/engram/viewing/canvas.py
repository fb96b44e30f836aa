"""Matplotlib behind one door: it is an extra, and draws into files only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import MissingExtraError


def subplots(count: int, *, width: float, height: float) -> tuple[Any, list[Any]]:
    """A figure with some axes in a row; sizes in inches.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError("pictures need Matplotlib: pip install 'engram[plots]'") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        1, count, figsize=(width, height), layout="constrained", squeeze=False
    )
    return figure, list(np.ravel(axes))


def save(figure: Any, path: Path) -> None:
    """Writes the figure and gives its memory back."""
    from matplotlib import pyplot

    figure.savefig(path, dpi=120)
    pyplot.close(figure)
