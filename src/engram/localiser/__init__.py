"""Live frame + neighbourhood + policy + budget → localisation; lost and found again."""

from engram.localiser.acceptance import (
    AcceptanceConfig,
    Prediction,
    Rule,
    accept,
    accept_lost,
    agrees,
    plausible,
)
from engram.localiser.attempts import FrameMatcher, Matcher
from engram.localiser.belief import BeliefConfig, PlaceBelief
from engram.localiser.given import UNNAMED_LIVE_SESSION, LiveDrive, MapParts
from engram.localiser.keeper import KEEPS_NOTHING, Hint, Keeper
from engram.localiser.localisation import (
    Budget,
    Localisation,
    LocalisationStatus,
    Position,
    StageClock,
)
from engram.localiser.localiser import Localiser
from engram.localiser.relocalisation import (
    RELOCALISERS,
    ByAppearance,
    Exhaustive,
    Relocaliser,
    best_places,
    spread,
)
from engram.localiser.settings import METHOD_VERSION, LocaliserConfig
from engram.localiser.spread import Spread

__all__ = [
    "KEEPS_NOTHING",
    "METHOD_VERSION",
    "RELOCALISERS",
    "UNNAMED_LIVE_SESSION",
    "AcceptanceConfig",
    "BeliefConfig",
    "Budget",
    "ByAppearance",
    "Exhaustive",
    "FrameMatcher",
    "Hint",
    "Keeper",
    "LiveDrive",
    "Localisation",
    "LocalisationStatus",
    "Localiser",
    "LocaliserConfig",
    "MapParts",
    "Matcher",
    "PlaceBelief",
    "Position",
    "Prediction",
    "Relocaliser",
    "Rule",
    "Spread",
    "StageClock",
    "accept",
    "accept_lost",
    "agrees",
    "best_places",
    "plausible",
    "spread",
]
