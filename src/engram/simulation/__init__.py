"""A town to drive in: rendered drives through changing light, weather and life, with truth."""

from engram.simulation.campaigns import (
    CAMPAIGNS,
    WORLD_VERSION,
    Campaign,
    SessionPlan,
    Size,
    campaign_named,
)
from engram.simulation.mesh import Kind
from engram.simulation.session import SimulatedDrive
from engram.simulation.truth import FrameTruth

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
