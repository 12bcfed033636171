"""Action masks: which choices of an action are allowed: of a Discrete, a MultiDiscrete, or such parts of others. Pure numpy.

Rule: a choice that is not allowed gets the logit, or the value, FORBIDDEN. This is a finite number, so nothing becomes NaN;
and its probability exp(FORBIDDEN − max) is exactly 0, so it adds nothing to an entropy, and its gradient is exactly 0.

A mask is [..., choices] bool. The choices of the entries of an action stand one after another. Their logits come before all
other parameters, and a stored row of a mixed action begins with what was chosen.
"""

from __future__ import annotations

import numpy as np

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.policy.distributions import Distribution, distribution
from millrace.protocol.policy.exploration import ActionValues, EpsilonGreedy, GreedyNoise
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec, RunSpec

MASK = "action_mask"  # the key in `info`, or in a Dict observation
FORBIDDEN = -1e30
_TINY = np.float32(1e-30)


def stored_leaves(run: RunSpec) -> tuple[Leaf, ...]:
    """The arrays of an observation as workers store them: in a masked run the mask is one more, the last."""
    leaves = run.policy.seen
    return (*leaves, Leaf(MASK, "multibinary", (run.policy.action.choices,), "bool")) if run.masked else leaves


def forbid(params: Floats, mask: Bools) -> Floats:
    """A copy of distribution parameters [..., P], or action values, in which the choices without True are FORBIDDEN.

    ε, which follows the action values, stays as it is.
    """
    masked = params.copy()
    np.copyto(masked[..., : mask.shape[-1]], np.float32(FORBIDDEN), where=~mask)
    return masked


def masked_distribution(spec: PolicySpec) -> Distribution:
    """The action distribution for parameters that `forbid` made."""
    return MaskedEpsilonGreedy(spec.action.sizes[0]) if spec.head == "q" else distribution(spec)


class MaskedEpsilonGreedy(EpsilonGreedy):
    """The allowed action with the highest value, or with probability ε an allowed action drawn uniformly."""

    def sample(self, params: Floats, noise: Floats) -> Array:
        """A sample, int64 from 0."""
        allowed = _allowed(params)
        whether, which = GreedyNoise.of(noise)
        number = (which * allowed.sum(-1)).astype(np.int64)  # among those that are allowed
        uniform = (allowed.cumsum(-1) > number[..., None]).argmax(-1)
        return np.where(whether < ActionValues.of(params).epsilon, uniform, self.mode(params))

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """log(ε / m + (1 − ε) [action is the best]) [...] with m allowed actions, at least −69."""
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
