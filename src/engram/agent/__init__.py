"""The robot's side of the centre: offline first."""

from engram.agent.agent import Agent, enrol
from engram.agent.settings import AgentSettings

__all__ = ["Agent", "AgentSettings", "enrol"]
