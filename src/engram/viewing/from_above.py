"""A map from above: its experiences in colour, its edges, where a drive was localised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.files import check_output
from engram.untrusted import printable
from engram.viewing.canvas import matplotlib_for_files, save, subplots


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One line of the picture.

    Attributes:
        label: label in the legend.
        points_m: (N, 2) float64, x and y in the map frame, metres.
        colour: Matplotlib colour; None for the next of a series.
    """

    label: str
    points_m: NDArray[np.float64]
    colour: str | None = None


def draw_from_above(
    tracks: Sequence[Track],
    path: Path,
    title: str,
    marks: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> None:
    """Draws tracks from above into an image file.

    Args:
        tracks: the lines.
        path: image file.
        title: title of the picture.
        marks: places with their names, x and y, metres.

    Raises:
        InputError: the file cannot be written.
        MissingExtraError: Matplotlib is not installed.
    """
    draw_panels([(title, tracks)], path, marks)


def draw_panels(
    panels: Sequence[tuple[str, Sequence[Track]]],
    path: Path,
    marks: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> None:
    """Draws tracks from above, side by side.

    Args:
        panels: title and tracks of each; a label has the same colour in all of them.
        path: image file.
        marks: places with their names in every panel, x and y, metres.

    Raises:
        InputError: the file cannot be written.
        MissingExtraError: Matplotlib is not installed.
    """
    names = dict.fromkeys(_name(track) for _, tracks in panels for track in tracks)
    colours = {name: f"C{number % 10}" for number, name in enumerate(names)}
    figure, all_axes = subplots(len(panels), width=7 * len(panels), height=6)
    for axes, (title, tracks) in zip(all_axes, panels, strict=True):
        for track in tracks:
            x, y = track.points_m[:, 0], track.points_m[:, 1]
            colour = track.colour or colours[_name(track)]
            axes.plot(x, y, ".", color=colour, markersize=5, label=_shown(track.label))
        for name, place in marks.items():
            axes.plot(*place, "*", color="black", markersize=9)
            axes.annotate(
                _shown(name), place, xytext=(5, 5), textcoords="offset points", fontsize=8
            )
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x, m")
        axes.set_ylabel("y, m")
        axes.set_title(_shown(title))
        if tracks:
            axes.legend(fontsize=8, loc="best")
    save(figure, path)


def _shown(text: str) -> str:
    """A text of a stranger's map: without control characters and Matplotlib's formulas."""
    return printable(text).replace("$", r"\$")


def _name(track: Track) -> str:
    """The label of a track without its count."""
    return track.label.split(" (")[0]


def check_picture(path: Path) -> None:
    """Checks before the work whether a picture can be written to a path.

    Raises:
        InputError: the folder does not exist or is not writable, or the file extension is unknown.
        MissingExtraError: Matplotlib is not installed.
    """
    check_output(path)
    formats = matplotlib_for_files().figure.Figure().canvas.get_supported_filetypes()
    ending = path.suffix.removeprefix(".").lower()
    if ending not in formats:  # Matplotlib would write another file, NAME.png
        raise InputError(
            f"the picture {path} cannot be written: .{ending} is not one of {', '.join(formats)}"
        )
