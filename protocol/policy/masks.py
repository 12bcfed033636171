"""Action masks say which choices of Discrete and MultiDiscrete actions, or of such parts of an action, are allowed. Pure.

Rule: the logit, or the value, of a choice that is not allowed is replaced by FORBIDDEN. This is a finite number, so nothing
becomes NaN. The probability exp(FORBIDDEN − max) of such a choice is exactly 0, so it adds nothing to the entropy, and its
gradient is exactly 0.

A mask is [..., choices] bool: the choices of all entries of an action, one entry after another. The logits of the choices
come before all other distribution params, and a stored row of a mixed action begins with the choices that were made.
"""

from __future__ import annotations

import numpy as np

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.policy.distributions import Distribution, distribution
from millrace.protocol.policy.exploration import ActionValues, EpsilonGreedy, GreedyNoise
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec, RunSpec

MASK = "action_mask"  # key of the mask in `info`, or in a Dict observation
FORBIDDEN = -1e30
_TINY = np.float32(1e-30)


def stored_leaves(run: RunSpec) -> tuple[Leaf, ...]:
    """The arrays of an observation as workers store them. In a masked run, the mask is an additional array, the last one."""
    leaves = run.policy.seen
    return (*leaves, Leaf(MASK, "multibinary", (run.policy.action.choices,), "bool")) if run.masked else leaves


def forbid(params: Floats, mask: Bools) -> Floats:
    """A copy of distribution params [..., P] with FORBIDDEN as the logit or value of each choice that is not allowed.

    ε, which follows the action values, stays as it is.
    """
    masked = params.copy()
    np.copyto(masked[..., : mask.shape[-1]], np.float32(FORBIDDEN), where=~mask)
    return masked


def masked_distribution(spec: PolicySpec) -> Distribution:
    """The action distribution for params to which `forbid` was applied."""
    return MaskedEpsilonGreedy(spec.action.sizes[0]) if spec.head == "q" else distribution(spec)


class MaskedEpsilonGreedy(EpsilonGreedy):
    """The allowed action with the highest value, or, with probability ε, one drawn uniformly from all allowed actions."""

    def sample(self, params: Floats, noise: Floats) -> Array:
        """The sampled actions, as zero-based int64 indices."""
        allowed = _allowed(params)
        whether, which = GreedyNoise.of(noise)
        number = (which * allowed.sum(-1)).astype(np.int64)  # index among the allowed actions
        uniform = (allowed.cumsum(-1) > number[..., None]).argmax(-1)
        return np.where(whether < ActionValues.of(params).epsilon, uniform, self.mode(params))

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """log(ε / m + (1 − ε) [action is the best]) [...], where m is the number of allowed actions; at least −69."""
        epsilon = ActionValues.of(params).epsilon
        count = _allowed(params).sum(-1).astype(np.float32)
        chance = epsilon / count + (1 - epsilon) * (action == self.mode(params))
        return np.asarray(np.log(np.maximum(chance, _TINY)), np.float32)


def _allowed(params: Floats) -> Bools:
    return np.asarray(ActionValues.of(params).values != np.float32(FORBIDDEN))


def no_choice(mask: Bools, action: ActionSpec) -> Bools:
    """[...] True where some entry of the action has no allowed choice."""
    starts = np.cumsum((0, *action.sizes[:-1]))
    return np.asarray(~np.logical_or.reduceat(mask, starts, -1).all(-1))


def not_allowed(stored: Array, mask: Bools, action: ActionSpec) -> Bools:
    """[...] True where a stored action [..., *action] has a choice that the mask [..., choices] forbids."""
    lead = mask.shape[:-1]
    starts = np.cumsum((0, *action.sizes[:-1]))
    chosen = stored.reshape(*lead, -1)[..., : len(starts)].astype(np.int64, copy=False)
    return np.asarray(~np.take_along_axis(mask, chosen + starts, -1).all(-1))
