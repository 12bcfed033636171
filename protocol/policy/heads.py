"""How the heads of policies differ, as plain data.

Rule: a fact is here if several files need it. What a single file computes differently for each head is in that file: the
shapes of the layers (`layout.py`), the action distributions (`distributions.py`, `torch_distributions.py`, `masks.py`) and
the action spaces (`possible.py`). The learner has the networks that it trains (`learner/algorithms/bodies/networks.py`).
"""

from __future__ import annotations

from typing import NamedTuple


class PolicyHead(NamedTuple):
    """The outputs of a policy; `PolicySpec.head` describes each kind."""

    prefix: str = "actor"
    """the prefix of the names of the layers that are needed to act, as in `actor.out`"""
    has_log_std_outputs: bool = False
    """whether the second half of the outputs are log standard deviations, which are clipped to `LOG_STD_BOUNDS`"""
    exploration: tuple[str, ...] = ()
    """the exploration parameters: one number each, which the learner sends as the last buffers"""
    stores_scaled_actions: bool = False
    """whether stored actions are in [-1, 1], and -1 and 1 stand for the bounds of the Box"""


HEADS: dict[str, PolicyHead] = {
    "actor_critic": PolicyHead(),
    "q": PolicyHead(prefix="q", exploration=("epsilon",)),
    "squashed": PolicyHead(has_log_std_outputs=True, exploration=("warm_up",), stores_scaled_actions=True),
    "deterministic": PolicyHead(exploration=("noise_scale", "warm_up"), stores_scaled_actions=True),
}
