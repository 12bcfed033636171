"""The interface of acting policies, and the choice of an implementation for a spec."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.specs import PolicySpec
from millrace.protocol.wire.weight_dtypes import ActingDtype


class Policy(Protocol):
    """Computes distribution params [L, N, P] float32 for the observations [L, N, *leaf] of N copies in each of L lanes.

    `state` [L, N, S] float32 is the state of the recurrent core. A call updates it in place
    (`millrace.protocol.policy.recurrent`).
    """

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Use these weights from now on."""
        ...

    def __call__(self, leaves: Sequence[Array], state: Floats | None = None) -> Floats:
        """Distribution params for these observations. Without `state`, each observation is the first of its episode."""
        ...


def make_policy(spec: PolicySpec, images: ActingDtype = "float32") -> Policy:
    """The policy of this spec. An MLP runs in numpy, without importing torch; a policy with images or an encoder runs in
    torch.

    `images` is the precision in which images are processed.
    """
    if not spec.needs_torch:
        return NumpyPolicy(spec)
    from millrace.protocol.policy.torch_policy import TorchPolicy

    return TorchPolicy(spec, images=images)
