"""A map from above: its experiences in colour, its edges, where a drive was localised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.errors import MissingExtraError


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One line of the picture.

    Attributes:
        label: for the legend.
        points_m: (N, 2) float64, x to the right and z forward in the picture's frame, metres.
    """

    label: str
    points_m: NDArray[np.float64]


def draw_from_above(tracks: Sequence[Track], path: Path, title: str) -> None:
    """Draws tracks from above into an image file.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    figure, axes = _axes()
    for number, track in enumerate(tracks):
        x, z = track.points_m[:, 0], track.points_m[:, 1]
        colour = f"C{number % 10}"
        axes.plot(x, z, ".", color=colour, markersize=5, label=track.label)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    axes.set_title(title)
    axes.legend(fontsize=8, loc="best")
    _save(figure, path)


def draw_attempts(attempts: Mapping[str, NDArray[np.int64]], path: Path, title: str) -> None:
    """Draws the attempts that each frame took, one line per policy.

    Args:
        attempts: policy → (F,) attempts of each frame.
        path: image file.
        title: over the picture.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    figure, axes = _axes(wide=True)
    for policy, counts in attempts.items():
        axes.step(np.arange(len(counts)), counts, where="mid", label=policy, linewidth=1.2)
    axes.set_xlabel("live frame")
    axes.set_ylabel("match attempts")
    axes.set_ylim(0, None)
    axes.set_title(title)
    axes.legend(fontsize=8)
    _save(figure, path)


def _axes(wide: bool = False):  # type: ignore[no-untyped-def]  # noqa: ANN202, Matplotlib's types
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError(
            "pictures of maps need Matplotlib: pip install 'engram[plots]'"
        ) from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(figsize=(9, 3.2) if wide else (7, 6), layout="constrained")


def _save(figure, path: Path) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001, as above
    from matplotlib import pyplot

    figure.savefig(path, dpi=120)
    pyplot.close(figure)
