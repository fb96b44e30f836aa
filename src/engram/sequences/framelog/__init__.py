"""Frame logs: the recorded output of front-end and odometry in one SQLite file."""

from engram.sequences.framelog.header import FrameLogHeader
from engram.sequences.framelog.reader import FrameLog, is_framelog, open_framelog
from engram.sequences.framelog.writer import FrameLogWriter

__all__ = ["FrameLog", "FrameLogHeader", "FrameLogWriter", "is_framelog", "open_framelog"]
