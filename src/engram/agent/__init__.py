"""The robot's side of the centre: offline first."""

from engram.agent.agent import Agent
from engram.agent.enrolment import enrol
from engram.agent.settings import AgentSettings

__all__ = ["Agent", "AgentSettings", "enrol"]
