"""Corrections of a session's robot, zone and start."""

from __future__ import annotations

from collections.abc import Mapping

from engram.errors import InputError
from engram.graph.clock import check_zone
from engram.graph.model import LONGEST_NAME, Amendable, Amendment, Session
from engram.maps.rows import START, checked_text


def checked_amendments(
    shown: Session, changes: Mapping[Amendable, str], now_ns: int
) -> dict[Amendable, Amendment]:
    """The amendments that change a session.

    Raises:
        InputError: none does, or a value is not valid.
        ConfigError: the zone is unknown.
    """
    found = {}
    for what, value in changes.items():
        checked_text(value, what)
        if what is Amendable.ZONE:
            check_zone(value)
        if (
            not value
            or (what is Amendable.ROBOT and len(value) > LONGEST_NAME)
            or (what is Amendable.START and not START.fullmatch(value))
        ):
            raise InputError(f"{value!r:.60} is not valid as the {what} of a session")
        amendment = Amendment(shown.id, what, value, now_ns)
        if amendment.applied(shown) != shown:
            found[what] = amendment
    if not found:
        raise InputError(f"session {shown.id} has these values already: nothing to amend")
    return found
