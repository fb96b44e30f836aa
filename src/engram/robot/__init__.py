"""Whole drives: open, replay, record, map, localise, summarise."""

from engram.maps import open_map
from engram.robot.inspecting import check_map, describe_map, seal_map
from engram.robot.live import LiveFrame, live_frames
from engram.robot.live_robot import LiveRobot
from engram.robot.localising import LocaliseOptions, LocaliseRun
from engram.robot.mapping import MapOptions, MapReport, map_drive
from engram.robot.recording import ExtractReport, extract_log
from engram.robot.results import FrameResult, measured, summarise
from engram.robot.session import DriveSequence, open_drive, session_of_drive
from engram.robot.settings import Settings, load_settings

__all__ = [
    "DriveSequence",
    "ExtractReport",
    "FrameResult",
    "LiveFrame",
    "LiveRobot",
    "LocaliseOptions",
    "LocaliseRun",
    "MapOptions",
    "MapReport",
    "Settings",
    "check_map",
    "describe_map",
    "extract_log",
    "live_frames",
    "load_settings",
    "map_drive",
    "measured",
    "open_drive",
    "open_map",
    "seal_map",
    "session_of_drive",
    "summarise",
]
