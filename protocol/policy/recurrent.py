"""The recurrent core of a policy, in numpy. Pure; imports no torch.

The core is between the features and the hidden layers. Each env copy has its own state [..., S]. The row format defines when
the state is reset. If row t is valid, `obs[t+1]` is processed with the state after `obs[t]`. If row t is not valid, it only
resets the copy, and `obs[t+1]` is processed with a state of zeros. (While a policy acts, `workers/lanes/runner.py` steps its
lanes and sets the state to zeros.) The final observation of an episode is therefore still processed with that episode's
state.

A core is an LSTM (Hochreiter and Schmidhuber 1997) or a GRU (Cho et al. 2014). Both are computed as in torch, with torch's
order of gates.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Floats
from millrace.protocol.specs import PolicySpec

GATES = {"lstm": 4, "gru": 3}  # number of gates, where the candidate state counts as one
MOST_OUTPUT = 1.01  # largest output of a core; it is 1 without rounding


def zero_state(spec: PolicySpec, *lead: int) -> Floats:
    """The state at the beginning of an episode: zeros [*lead, S]. S is 0 without a core."""
    return np.zeros((*lead, spec.state_size), np.float32)


def is_possible(spec: PolicySpec, state: Floats) -> bool:
    """Whether a policy can have these states [..., S]. They are finite, and a core's output is a mean of numbers between -1
    and 1, except for rounding. With a larger output, the core's next step could overflow.
    """
    output = state[..., : spec.core_size if spec.core else 0]
    return bool(np.isfinite(state).all() and (np.abs(output) <= MOST_OUTPUT).all())


def core_shapes(spec: PolicySpec, inputs: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The shapes [out, in] of the two linear maps to the gates: from `inputs` inputs, and from the state."""
    assert spec.core is not None
    gates = GATES[spec.core] * spec.core_size
    return (gates, inputs), (gates, spec.core_size)


def advance(spec: PolicySpec, parameters: Mapping[str, npt.NDArray[Any]], x: Floats, state: Floats) -> Floats:
    """Advance the core by one step with input x [..., D], updating `state` [..., S] in place.

    Returns the output [..., core_size].
    """

    def linear(name: str, values: Floats) -> Floats:
        out = np.matmul(values, parameters[f"{name}.weight"].T)
        out += parameters[f"{name}.bias"]
        return np.asarray(out)

    H = spec.core_size
    h = state[..., :H]
    gates = linear("core.input", x)
    remembered = linear("core.state", h)
    if spec.core == "lstm":
        gates += remembered
        take, forget, new, out = (gates[..., i * H : (i + 1) * H] for i in range(4))
        c = state[..., H:]
        c[...] = _sigmoid(forget) * c + _sigmoid(take) * np.tanh(new)
        h[...] = _sigmoid(out) * np.tanh(c)
    else:
        both = _sigmoid(gates[..., : 2 * H] + remembered[..., : 2 * H])
        reset = both[..., :H]
        keep = both[..., H:]
        new = np.tanh(gates[..., 2 * H :] + reset * remembered[..., 2 * H :])
        h[...] = new + keep * (h - new)
    return h.copy()


def _sigmoid(z: Floats) -> Floats:
    """The sigmoid, computed with tanh, which does not overflow and gives the same bits for every array size."""
    return np.asarray(0.5 + 0.5 * np.tanh(np.float32(0.5) * z), np.float32)
