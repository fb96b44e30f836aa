"""Whole drives: open, replay, record, map, localise, summarise. Imported when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from engram.maps import open_map
    from engram.robot.examining import examine_drive
    from engram.robot.front import Front, arriving
    from engram.robot.inspecting import check_map, describe_map, seal_map
    from engram.robot.mapping import Beginning, MapReport, map_drive
    from engram.robot.recorder import Recorder, RecorderConfig
    from engram.robot.recording import ExtractReport, extract_log
    from engram.robot.results import localise_drive, measure, measured, summarise
    from engram.robot.robot import Robot
    from engram.robot.session import DriveSequence, session_of_drive
    from engram.robot.settings import RobotOptions, Settings, load_settings
    from engram.robot.starting import robot_on
    from engram.sequences import open_drive

__all__ = [
    "Beginning",
    "DriveSequence",
    "ExtractReport",
    "Front",
    "MapReport",
    "Recorder",
    "RecorderConfig",
    "Robot",
    "RobotOptions",
    "Settings",
    "arriving",
    "check_map",
    "describe_map",
    "examine_drive",
    "extract_log",
    "load_settings",
    "localise_drive",
    "map_drive",
    "measure",
    "measured",
    "open_drive",
    "open_map",
    "robot_on",
    "seal_map",
    "session_of_drive",
    "summarise",
]

_HOMES = {
    "open_map": "engram.maps",
    "examine_drive": "engram.robot.examining",
    "Front": "engram.robot.front",
    "arriving": "engram.robot.front",
    "check_map": "engram.robot.inspecting",
    "describe_map": "engram.robot.inspecting",
    "seal_map": "engram.robot.inspecting",
    "Beginning": "engram.robot.mapping",
    "MapReport": "engram.robot.mapping",
    "map_drive": "engram.robot.mapping",
    "Recorder": "engram.robot.recorder",
    "RecorderConfig": "engram.robot.recorder",
    "ExtractReport": "engram.robot.recording",
    "extract_log": "engram.robot.recording",
    "localise_drive": "engram.robot.results",
    "measure": "engram.robot.results",
    "measured": "engram.robot.results",
    "summarise": "engram.robot.results",
    "Robot": "engram.robot.robot",
    "DriveSequence": "engram.robot.session",
    "session_of_drive": "engram.robot.session",
    "RobotOptions": "engram.robot.settings",
    "Settings": "engram.robot.settings",
    "load_settings": "engram.robot.settings",
    "robot_on": "engram.robot.starting",
    "open_drive": "engram.sequences",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'engram.robot' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
