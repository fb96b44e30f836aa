"""Whole drives: open, replay, record, map, localise, summarise."""

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
