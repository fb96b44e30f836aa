"""A town to drive in: rendered drives through changing light, weather and life, with truth."""

from engram_lab.town.campaigns import (
    CAMPAIGNS,
    WORLD_VERSION,
    Campaign,
    SessionPlan,
    Size,
    campaign_named,
)
from engram_lab.town.mesh import Kind
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.truth import FrameTruth

__all__ = [
    "CAMPAIGNS",
    "WORLD_VERSION",
    "Campaign",
    "FrameTruth",
    "Kind",
    "SessionPlan",
    "SimulatedDrive",
    "Size",
    "campaign_named",
]
