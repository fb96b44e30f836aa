"""Whole drives: open, replay, extract, map, localise, summarise."""

from engram.drive.difference import MapDifference, diff_revisions
from engram.drive.extracting import ExtractReport, extract_log
from engram.drive.history import (
    RevertReport,
    blame_node,
    delete_tag,
    map_log,
    map_tags,
    revert_revision,
    show_revision,
    tag_revision,
)
from engram.drive.inspecting import check_map, describe_map, seal_map
from engram.drive.live import LiveFrame, live_frames
from engram.drive.localising import LocaliseOptions, LocaliseRun
from engram.drive.mapping import MapOptions, MapReport, map_drive
from engram.drive.opened_map import LiveRobot, OpenMap, open_map
from engram.drive.pictures import PictureWriter
from engram.drive.results import FrameResult, measured, summarise
from engram.drive.session import DriveSequence, open_drive, session_of_drive
from engram.drive.settings import Settings, load_settings
from engram.drive.simulating import SimulateReport, campaign_folder, simulate
from engram.drive.there_and_back import ThereAndBack
from engram.drive.trajectory import chain_trajectory, write_trajectory

__all__ = [
    "DriveSequence",
    "ExtractReport",
    "FrameResult",
    "LiveFrame",
    "LiveRobot",
    "LocaliseOptions",
    "LocaliseRun",
    "MapDifference",
    "MapOptions",
    "MapReport",
    "OpenMap",
    "PictureWriter",
    "RevertReport",
    "Settings",
    "SimulateReport",
    "ThereAndBack",
    "blame_node",
    "campaign_folder",
    "chain_trajectory",
    "check_map",
    "delete_tag",
    "describe_map",
    "diff_revisions",
    "extract_log",
    "live_frames",
    "load_settings",
    "map_drive",
    "map_log",
    "map_tags",
    "measured",
    "open_drive",
    "open_map",
    "revert_revision",
    "seal_map",
    "session_of_drive",
    "show_revision",
    "simulate",
    "summarise",
    "tag_revision",
    "write_trajectory",
]
