"""Engram: lifelong visual localisation for fleets of robots with stereo cameras.

The names below are what integrators need; each is documented where it is defined. They are
imported when first used, so that ``import engram`` and ``engram --help`` cost nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from engram.errors import EngramError
    from engram.frontend.frame import StereoPair
    from engram.geometry.cameras import StereoCamera
    from engram.geometry.se3 import SE3
    from engram.localiser.localisation import Budget, Localisation, LocalisationStatus, Position
    from engram.maps.map import Map, open_map
    from engram.odometry.outside import OutsideMotion
    from engram.robot.mapping import map_drive
    from engram.robot.robot import Robot
    from engram.robot.settings import Settings
    from engram.sequences.opening import open_drive

__version__ = "0.2.0"

__all__ = [
    "SE3",
    "Budget",
    "EngramError",
    "Localisation",
    "LocalisationStatus",
    "Map",
    "OutsideMotion",
    "Position",
    "Robot",
    "Settings",
    "StereoCamera",
    "StereoPair",
    "__version__",
    "map_drive",
    "open_drive",
    "open_map",
]

_HOMES = {
    "SE3": "engram.geometry.se3",
    "Budget": "engram.localiser.localisation",
    "EngramError": "engram.errors",
    "OutsideMotion": "engram.odometry.outside",
    "Robot": "engram.robot.robot",
    "Localisation": "engram.localiser.localisation",
    "LocalisationStatus": "engram.localiser.localisation",
    "Map": "engram.maps.map",
    "Position": "engram.localiser.localisation",
    "Settings": "engram.robot.settings",
    "StereoCamera": "engram.geometry.cameras",
    "StereoPair": "engram.frontend.frame",
    "map_drive": "engram.robot.mapping",
    "open_drive": "engram.sequences.opening",
    "open_map": "engram.maps.map",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'engram' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
