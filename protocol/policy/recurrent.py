"""A recurrent core: what a policy remembers of an episode. Pure; imports no torch.

It stands between an observation's features and the hidden layers. Its state [..., S] belongs to an env copy: the law of a
row says where it begins anew. Before `obs[t+1]` it is what `obs[t]` left behind where row t is valid, and zeros where it is
not, because that row is the reset. So the final observation of an episode is still seen with the episode's memory.

LSTM (Hochreiter and Schmidhuber 1997) and GRU (Cho et al. 2014) as torch computes them, with its order of gates.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.arrays import Floats
from protocol.specs import PolicySpec

GATES = {"lstm": 4, "gru": 3}


def zero_state(spec: PolicySpec, *lead: int) -> Floats:
    """Of copies whose episodes begin: [*lead, S]; S is 0 without a core."""
    return np.zeros((*lead, spec.state_size), np.float32)


def core_shapes(spec: PolicySpec, inputs: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """[out, in] of the two linear maps into the gates: from the inputs, and from the state."""
    assert spec.core is not None
    gates = GATES[spec.core] * spec.core_size
    return (gates, inputs), (gates, spec.core_size)


def advance(spec: PolicySpec, parameters: Mapping[str, npt.NDArray[Any]], x: Floats, state: Floats) -> Floats:
    """See x [..., D] with `state` [..., S], which is moved on in place; what the core then says, [..., core_size]."""

    def linear(name: str, values: Floats) -> Floats:
        out = np.matmul(values, parameters[f"{name}.weight"].T)
        out += parameters[f"{name}.bias"]
        return np.asarray(out)

    H = spec.core_size
    h = state[..., :H]
    gates, remembered = linear("core.input", x), linear("core.state", h)
    if spec.core == "lstm":
        gates += remembered
        take, forget, new, out = (gates[..., i * H : (i + 1) * H] for i in range(4))
        c = state[..., H:]
        c[...] = _sigmoid(forget) * c + _sigmoid(take) * np.tanh(new)
        h[...] = _sigmoid(out) * np.tanh(c)
    else:
        both = _sigmoid(gates[..., : 2 * H] + remembered[..., : 2 * H])
        reset, keep = both[..., :H], both[..., H:]
        new = np.tanh(gates[..., 2 * H :] + reset * remembered[..., 2 * H :])
        h[...] = new + keep * (h - new)
    return h.copy()


def _sigmoid(z: Floats) -> Floats:
    """By tanh, which neither overflows nor depends on how many numbers are computed together."""
    return np.asarray(0.5 + 0.5 * np.tanh(np.float32(0.5) * z), np.float32)
