"""Engram: lifelong visual localisation for fleets of robots with stereo cameras.

The names below are what integrators need; each is documented where it is defined. They are
imported when first used, so that ``import engram`` and ``engram --help`` cost nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from engram.errors import EngramError
    from engram.frontend import StereoPair
    from engram.geometry import SE3, StereoCamera
    from engram.localiser import Budget, Localisation, LocalisationStatus, Position
    from engram.maps import Map, open_map
    from engram.odometry import OutsideMotion
    from engram.robot import Robot, Settings, map_drive, open_drive

__version__ = "0.2.0a1"
# Printed where somebody might rely on more: by `--version`, and beside a format that is refused.
PRE_RELEASE = "a pre-release: map format, settings and Python names may change without notice"

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
    "SE3": "engram.geometry",
    "Budget": "engram.localiser",
    "EngramError": "engram.errors",
    "OutsideMotion": "engram.odometry",
    "Robot": "engram.robot",
    "Localisation": "engram.localiser",
    "LocalisationStatus": "engram.localiser",
    "Map": "engram.maps",
    "Position": "engram.localiser",
    "Settings": "engram.robot",
    "StereoCamera": "engram.geometry",
    "StereoPair": "engram.frontend",
    "map_drive": "engram.robot",
    "open_drive": "engram.robot",
    "open_map": "engram.maps",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'engram' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
