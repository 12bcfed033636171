"""What is missing in an object that looks like a multi-agent environment but isn't a PettingZoo environment. Pure."""

from __future__ import annotations

from millrace.protocol.errors import words_an_error

MARKS = ("possible_agents", "agents", "agent_iter", "agent_selection", "observation_spaces")
"""Attributes that single-agent environments don't have."""


@words_an_error
def what_it_lacks(made: object) -> str:
    """What an object lacks to be a PettingZoo environment, as the end of a line; empty if it doesn't look like one."""
    if not any(_has(made, name) for name in MARKS) and not callable(getattr(made, "observation_space", None)):
        return ""
    if not _has(made, "possible_agents"):
        return "it needs possible_agents, a list of all agents that there may be, before its first reset"
    for name in ("observation_space", "action_space"):
        if not callable(getattr(made, name, None)):
            return f"it needs a method {name}(agent), which returns the space of this agent"
    return ""


def _has(made: object, name: str) -> bool:
    try:
        return hasattr(made, name)
    except Exception:  # a user-defined property raised, so it exists
        return True
