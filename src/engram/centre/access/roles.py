"""Roles on a map, and who asks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from engram.centre.errors import NotAllowedError, UnknownError

ALL_MAPS = "*"


class Role(StrEnum):
    """Role of a person or robot on a map."""

    VIEWER = "viewer"  # reads the map, its history and the state of the fleet
    ROBOT = "robot"  # downloads, its own hand-ins and reports
    OPERATOR = "operator"  # moves refs, reverts, merges what a gate refused, cancels
    ADMIN = "admin"  # enrols robots, sets a map's options


# Roles that may do what a role may.
_INCLUDES: Mapping[Role, frozenset[Role]] = {
    Role.VIEWER: frozenset({Role.VIEWER, Role.OPERATOR, Role.ADMIN}),
    Role.ROBOT: frozenset({Role.ROBOT}),
    Role.OPERATOR: frozenset({Role.OPERATOR, Role.ADMIN}),
    Role.ADMIN: frozenset({Role.ADMIN}),
}


@dataclass(frozen=True, slots=True)
class Subject:
    """The caller of a request.

    Attributes:
        id: of the robot or person.
        name: for people.
        roles: by map; `ALL_MAPS` for every map.
    """

    id: str
    name: str
    roles: Mapping[str, Role]

    def role_on(self, name: str) -> Role | None:
        """The role on a map; None without one."""
        return self.roles.get(name, self.roles.get(ALL_MAPS))

    def check(self, name: str, *roles: Role) -> None:
        """Refuses who has none of the roles on a map.

        Raises:
            UnknownError: no role at all: that the map exists is not revealed.
            NotAllowedError: another role.
        """
        role = self.role_on(name)
        if role is None:
            raise UnknownError(f"you have no access to a map {name!r:.60}")
        if not any(role in _INCLUDES[one] for one in roles):
            raise NotAllowedError(
                f"a role of {role} may not do this; it needs {' or '.join(roles)}"
            )
