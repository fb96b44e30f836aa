"""Times and drives as people say them: Mon 14 Jul 08:30, wildcat."""

from __future__ import annotations

from datetime import UTC, datetime

from engram.graph.clock import known_zone
from engram.graph.model import Clock, Session
from engram.untrusted import printable


def moment(session: Session, stamp_ns: int, *, with_year: bool = False) -> str:
    """A stamp of a session: the local time where its zone is known, else UTC, else seconds."""
    if session.clock is not Clock.UTC:
        return f"{(stamp_ns - session.start_ns) / 1e9:.1f} s"
    zone = known_zone(session.zone)
    try:
        then = datetime.fromtimestamp((stamp_ns + session.shift_ns) / 1e9, UTC)
    except (ValueError, OverflowError, OSError):  # a year that no calendar has
        return f"{stamp_ns / 1e9:.1f} s"
    local = then if zone is None else then.astimezone(zone)
    year = f" {local.year}" if with_year else ""
    utc = " UTC" if zone is None else ""
    return f"{local:%a} {local.day} {local:%b}{year} {local:%H:%M}{utc}"


def drive_text(session: Session) -> str:
    """A drive by its start and its robot; by its id where it has no time of day."""
    robot = printable(session.robot)
    if session.clock is not Clock.UTC:
        return f"{robot}, {str(session.id)[:8]}"
    return f"{moment(session, session.start_ns, with_year=True)}, {robot}"
