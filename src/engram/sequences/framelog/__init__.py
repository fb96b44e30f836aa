"""Frame logs: the recorded output of front-end and odometry in one SQLite file."""

from engram.sequences.framelog.flight import FlightWriter, read_decisions, read_images, read_report
from engram.sequences.framelog.header import FrameLogHeader
from engram.sequences.framelog.reader import FrameLog, is_framelog, open_framelog
from engram.sequences.framelog.writer import FrameLogWriter

__all__ = [
    "FlightWriter",
    "FrameLog",
    "FrameLogHeader",
    "FrameLogWriter",
    "is_framelog",
    "open_framelog",
    "read_decisions",
    "read_images",
    "read_report",
]
