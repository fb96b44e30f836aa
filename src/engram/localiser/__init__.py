"""Live frame + neighbourhood + policy + budget → localisation; lost and found again."""

from engram.localiser.acceptance import AcceptanceConfig, Prediction, accept
from engram.localiser.attempts import FrameMatcher, Matcher
from engram.localiser.localisation import Budget, Localisation, LocalisationStatus, Position
from engram.localiser.localiser import UNNAMED_LIVE_SESSION, Localiser, LocaliserConfig
from engram.localiser.relocalisation import RELOCALISERS, Exhaustive, Relocaliser, Searched
from engram.localiser.walk import Walk

__all__ = [
    "RELOCALISERS",
    "UNNAMED_LIVE_SESSION",
    "AcceptanceConfig",
    "Budget",
    "Exhaustive",
    "FrameMatcher",
    "Localisation",
    "LocalisationStatus",
    "Localiser",
    "LocaliserConfig",
    "Matcher",
    "Position",
    "Prediction",
    "Relocaliser",
    "Searched",
    "Walk",
    "accept",
]
