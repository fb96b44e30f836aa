"""Files of anchors: CSV, GeoJSON, and pixels of an occupancy grid."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from engram.calibration.entries import MAX_CHARACTERS, read_yaml
from engram.errors import ConfigError, InputError
from engram.maps.map_frame import FARTHEST_M
from engram.sequences.images import image_size
from engram.sequences.options import parse_time
from engram.untrusted import read_text

# Farthest in time from a node that a line with a time may be.
NEAR_NS = 500_000_000
# Nothing is surveyed better.
_LEAST_SIGMA_M = 1e-4


@dataclass(frozen=True, slots=True)
class GivenAnchor:
    """One line of a file of anchors.

    Attributes:
        line: its number, for messages.
        node: UUID of a node, or its beginning; None if a time is given.
        time_ns: UTC, ns; None if a node is given.
        position: latitude and longitude in degrees, or x and y in metres, or pixels of a grid.
        z_m: height; None if unknown.
        sigma_m: standard deviation; None for the usual one.
    """

    line: int
    node: str | None
    time_ns: int | None
    position: tuple[float, float]
    z_m: float | None
    sigma_m: float | None


def read_anchors(source: Path) -> tuple[list[GivenAnchor], bool]:
    """The anchors of a file, and whether they are latitudes and longitudes.

    Raises:
        InputError: it cannot be read, or a line cannot be used; names file and line.
    """
    text = read_text(source, InputError)
    is_json = source.suffix.lower() in {".geojson", ".json"}
    rows = _json_rows(text, source) if is_json else _csv_rows(text, source)
    found = [(line, row) for line, row in rows]
    if not found:
        raise InputError(f"{source}: holds no anchors")
    kinds = {_kind(row, line, source) for line, row in found}
    if len(kinds) > 1:
        raise InputError(f"{source}: mixes {' and '.join(sorted('/'.join(k) for k in kinds))}")
    (kind,) = kinds
    return [_given(row, line, kind, source) for line, row in found], kind == ("lat", "lon")


_NAMES = {
    "latitude": "lat", "longitude": "lon", "lng": "lon", "altitude": "z", "alt": "z",
    "height": "z", "x_m": "x", "y_m": "y", "z_m": "z", "sigma_m": "sigma", "stamp": "time",
    "timestamp": "time",
}  # fmt: skip
_PAIRS = (("lat", "lon"), ("x", "y"), ("u", "v"))


def _csv_rows(text: str, source: Path) -> Iterable[tuple[int, dict[str, str]]]:
    reader = csv.DictReader(text.splitlines())
    if reader.fieldnames is None:
        raise InputError(f"{source}: is empty; expected a head such as node,x,y or time,lat,lon")
    for row in reader:
        yield (
            reader.line_num,
            {
                _NAMES.get(key.strip().lower(), key.strip().lower()): (value or "").strip()
                for key, value in row.items()
                if isinstance(key, str) and isinstance(value, str | None)
            },
        )


def _json_rows(text: str, source: Path) -> Iterable[tuple[int, dict[str, str]]]:
    try:
        features = json.loads(text)["features"]
        for number, feature in enumerate(features, start=1):
            longitude, latitude, *height = feature["geometry"]["coordinates"]
            given = {key.lower(): str(value) for key, value in feature["properties"].items()}
            row = {_NAMES.get(key, key): value for key, value in given.items()}
            row |= {"lat": str(latitude), "lon": str(longitude)}
            yield number, row | ({"z": str(height[0])} if height else {})
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{source}: is not a GeoJSON FeatureCollection of points ({type(error).__name__} "
            f"{error})"
        ) from error


def _kind(row: Mapping[str, str], line: int, source: Path) -> tuple[str, str]:
    for pair in _PAIRS:
        if all(row.get(name) for name in pair):
            return pair
    raise InputError(
        f"{source}, line {line}: no position; expected the columns lat,lon or x,y or u,v, "
        f"found {', '.join(row) or 'none'}"
    )


def _given(row: Mapping[str, str], line: int, kind: tuple[str, str], source: Path) -> GivenAnchor:
    def number(name: str) -> float | None:
        if not row.get(name):
            return None
        try:
            value = float(row[name])
        except ValueError:
            value = float("nan")
        if not abs(value) <= FARTHEST_M:
            raise InputError(
                f"{source}, line {line}: {name} {row[name]!r} is not a number of at most "
                f"{FARTHEST_M:g}"
            )
        return value

    node, time = row.get("node") or None, row.get("time") or None
    if (node is None) == (time is None):
        raise InputError(f"{source}, line {line}: give a node or a time, one of them")
    first, second = (number(name) for name in kind)
    assert first is not None
    assert second is not None
    if kind == ("lat", "lon") and not (abs(first) <= 90 and abs(second) <= 180):
        raise InputError(f"{source}, line {line}: {first}, {second} is not latitude, longitude")
    sigma_m = number("sigma")
    if sigma_m is not None and sigma_m < _LEAST_SIGMA_M:
        raise InputError(
            f"{source}, line {line}: sigma is {sigma_m}, must be at least {_LEAST_SIGMA_M:g} m"
        )
    time_ns = None if time is None else _time_ns(time, line, source)
    return GivenAnchor(line, node, time_ns, (first, second), number("z"), sigma_m)


def _time_ns(text: str, line: int, source: Path) -> int:
    """ISO 8601, or seconds since 1970."""
    try:
        return round(float(text) * 1e9)
    except (ValueError, OverflowError):
        pass
    try:
        found = parse_time("stamp", text)
    except ConfigError as error:
        raise InputError(f"{source}, line {line}: {error}") from error
    assert found is not None
    return found


def on_grid(given: list[GivenAnchor], grid: Path) -> list[GivenAnchor]:
    """Pixels of an occupancy grid as metres in its frame; metres stay."""
    try:
        about = read_yaml(read_text(grid, InputError, 4 * MAX_CHARACTERS))
        resolution = float(about["resolution"])
        left, bottom, turned = (float(value) for value in about["origin"][:3])
        picture = grid.parent / str(about["image"])
    except (KeyError, TypeError, ValueError) as error:  # InputError is a ValueError
        raise InputError(f"{grid}: is not a map.yaml of an occupancy grid: {error}") from error
    if turned:
        raise InputError(f"{grid}: its origin is turned by {turned} rad; only 0 is supported")
    _, height = image_size(picture)
    return [
        GivenAnchor(
            one.line, one.node, one.time_ns,
            (left + resolution * (one.position[0] + 0.5),
             bottom + resolution * (height - one.position[1] - 0.5)),
            one.z_m, one.sigma_m,
        )
        for one in given
    ]  # fmt: skip
