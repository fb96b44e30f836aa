"""Live frame + neighbourhood + policy + budget → localisation; lost and found again."""

from engram.localiser.acceptance import (
    AcceptanceConfig,
    Prediction,
    Spread,
    accept,
    accept_lost,
    agrees,
    plausible,
)
from engram.localiser.attempts import FrameMatcher, Matcher
from engram.localiser.belief import BeliefConfig, PlaceBelief
from engram.localiser.localisation import Budget, Localisation, LocalisationStatus, Position
from engram.localiser.localiser import UNNAMED_LIVE_SESSION, Localiser
from engram.localiser.place_book import PlaceBook, Searched
from engram.localiser.relocalisation import (
    RELOCALISERS,
    ByAppearance,
    Exhaustive,
    Relocaliser,
    best_places,
    spread,
)
from engram.localiser.settings import METHOD_VERSION, LocaliserConfig
from engram.localiser.walk import Walk

__all__ = [
    "METHOD_VERSION",
    "RELOCALISERS",
    "UNNAMED_LIVE_SESSION",
    "AcceptanceConfig",
    "BeliefConfig",
    "Budget",
    "ByAppearance",
    "Exhaustive",
    "FrameMatcher",
    "Localisation",
    "LocalisationStatus",
    "Localiser",
    "LocaliserConfig",
    "Matcher",
    "PlaceBelief",
    "PlaceBook",
    "Position",
    "Prediction",
    "Relocaliser",
    "Searched",
    "Spread",
    "Walk",
    "accept",
    "accept_lost",
    "agrees",
    "best_places",
    "plausible",
    "spread",
]
