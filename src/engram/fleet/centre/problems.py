"""Errors of the service, each with the status of its answer."""

from __future__ import annotations

from engram.errors import EngramError, MapError


class CentreError(EngramError):
    """A request that cannot be fulfilled as it is."""

    status = 400
    title = "The request cannot be served"


class UnknownError(CentreError):
    """The resource does not exist, or not for the caller."""

    status = 404
    title = "Not found"


class NotKnownError(CentreError):
    """The caller is not authenticated: the token is missing or has expired."""

    status = 401
    title = "A token is needed"


class NotAllowedError(CentreError):
    """The caller may not do that."""

    status = 403
    title = "Not allowed"


class ChangedError(CentreError):
    """The subject of the request has changed since."""

    status = 412
    title = "Changed meanwhile"


class ConflictError(CentreError):
    """The state does not allow the step."""

    status = 409
    title = "Not in this state"


class MalformedError(CentreError):
    """The uploaded parts do not make a valid map."""

    status = 422
    title = "No map"


class QuotaError(CentreError):
    """More than is granted."""

    status = 429
    title = "More than is granted"


class MissingPartsError(MapError):
    """Parts of a job are missing: the fleet map has changed since they were requested."""


class StoreError(MapError):
    """The centre's own database or objects cannot be read or written now: try again later."""
