"""Access to Matplotlib, an extra that draws into files only."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from engram.errors import InputError, MissingExtraError


def matplotlib_for_files() -> ModuleType:
    """Matplotlib without a window.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import matplotlib
        import matplotlib.figure
    except ImportError as error:
        raise MissingExtraError(
            "pictures need Matplotlib: pip install 'engram-localisation[plots]'"
        ) from error
    matplotlib.use("Agg")
    return matplotlib


def subplots(count: int, *, width: float, height: float, rows: int = 1) -> tuple[Any, list[Any]]:
    """A figure with `count` axes in `rows` rows, of which the last may be shorter.

    Width and height are those of the figure, in inches.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    matplotlib_for_files()
    from matplotlib import pyplot

    columns = -(-count // rows)
    figure, axes = pyplot.subplots(
        rows, columns, figsize=(width, height), layout="constrained", squeeze=False
    )
    every = list(np.ravel(axes))
    for unused in every[count:]:
        unused.remove()
    return figure, every[:count]


def save(figure: Any, path: Path) -> None:
    """Writes the figure and releases its memory.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib import pyplot

    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:  # no such folder; an unknown file extension
        raise InputError(f"the picture {path} cannot be written: {error}") from error
    finally:
        pyplot.close(figure)
