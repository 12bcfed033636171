"""An encoder, an actor and K critics as `StackedMLPs`. It replaces SAC's `ActorAndCritics`; its critics may have any form.

Rule: where a gradient is recorded (`torch.is_grad_enabled`), the actor is being trained, so it normalizes by the statistics
of its minibatch. Under `torch.no_grad`, and wherever critics stay constant, running statistics are used. SAC's losses can
therefore use this network unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.autograd_leaves import named_leaves, trainable
from millrace.learner.algorithms.bodies.networks import initial_fields
from millrace.learner.algorithms.bodies.stacked_mlps import MLPShape, StackedMLPs, initial, initial_statistics
from millrace.protocol.arrays import Floats
from millrace.protocol.policy.encoder import Encoder
from millrace.protocol.policy.layout import LOG_STD_BOUNDS, encoder_layout
from millrace.protocol.policy.malloc import keep_freed_memory
from millrace.protocol.policy.torch_distributions import squashed_sample
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.specs import PolicySpec


class ActorWithCritics:
    """A squashed Gaussian actor, and K critics that map features and actions to outputs that represent values."""

    def __init__(
        self,
        policy: PolicySpec,
        actor: MLPShape,
        critics: MLPShape,
        values_of: Callable[[Tensor], Tensor],
        device: str,
        seed: int,
    ) -> None:
        """`values_of` maps the critics' outputs [K, B, O] to values [K, B]. The initial parameters depend on `seed`."""
        keep_freed_memory()  # each pass allocates and frees arrays of half a megabyte
        generator = torch.Generator().manual_seed(torch_seed(seed, Purpose.WEIGHTS))
        fields, _ = encoder_layout(policy)
        parts = [initial(actor, generator), initial_fields(fields, generator), initial(critics, generator)]
        sizes = [len(part) for part in parts]
        self.flat = torch.cat(parts).to(device)
        """[A + E + C] float32, all parameters: A of the actor, then E of the encoder, then C of the critics"""
        self.flat_grad = torch.zeros_like(self.flat)
        self.acting_size = sizes[0] + sizes[1]
        """A + E, the number of parameters that compute actions"""
        self.actor, self._encoder, constant_critics = torch.split(self.flat, sizes)
        """[A], [E] and [C] in the memory of `flat`"""
        self.actor.grad, of_encoder, of_constant_critics = torch.split(self.flat_grad, sizes)
        self.critics = self.flat[sizes[0] :]
        """[E + C] in the memory of `flat`: the encoder, then the critics"""
        self.critics.grad = self.flat_grad[sizes[0] :]
        self.encode = Encoder(policy, named_leaves(self._encoder, of_encoder, fields), device, seed=seed)
        statistics = [initial_statistics(shape) for shape in (actor, critics)]
        self.statistics = torch.cat(statistics).to(device)
        """[S] the running statistics, the actor's first; empty without normalization"""
        of_actor, of_critics = torch.split(self.statistics, [len(part) for part in statistics])
        self.actor_body = StackedMLPs(actor, trainable(self.actor, self.actor.grad), of_actor)
        self.critic_bodies = StackedMLPs(critics, trainable(constant_critics, of_constant_critics), of_critics)
        self.project()
        self.renormalizes = False
        """whether training passes use batch renormalization"""
        self._values_of = values_of

    def params(self, x: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """Like `actor_params`, for features [B, D] and images [B, *leaf] uint8."""
        return self.actor_params(self.encode(x, images))

    def actor_params(self, h: Tensor) -> Tensor:
        """The actor's means and log standard deviations [B, 2 D′], before tanh, for inputs [B, H]."""
        if torch.is_grad_enabled():
            (out,) = self.actor_body.trained(h, renormalizes=self.renormalizes)
        else:
            (out,) = self.actor_body.evaluated(h)
        mean, log_std = out.chunk(2, -1)
        return torch.cat((mean, log_std.clamp(*LOG_STD_BOUNDS)), -1)

    def sample(self, h: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, D′] in [-1, 1] and their log-densities [B], for inputs [B, H] and noise [B, D′]."""
        return squashed_sample(self.actor_params(h), noise)

    def outputs(self, h: Tensor, action: Tensor) -> Tensor:
        """The critics' outputs [K, B, O] for inputs [B, H] and actions [B, D′], for training the critics."""
        return self.critic_bodies.trained(torch.cat((h, action), -1), renormalizes=self.renormalizes)

    def minibatch_outputs(self, h: Tensor, action: Tensor) -> Tensor:
        """Like `outputs`, but for target critics: without a gradient, and without moving the running statistics."""
        return self.critic_bodies.of_minibatch(torch.cat((h, action), -1))

    def values(self, h: Tensor, action: Tensor, *, constant: bool = True) -> Tensor:
        """The values [K, B] of inputs [B, H] and actions [B, D′]. The actions get a gradient; the critics don't."""
        assert constant, "outputs() is what critics are trained by"
        return self._values_of(self.critic_bodies.evaluated(torch.cat((h, action), -1)))

    def project(self) -> None:
        """See `StackedMLPs.project`."""
        self.actor_body.project()
        self.critic_bodies.project()

    def acting_parameters(self) -> Floats:
        """A copy of the parameters [P] that workers act with: first a plain MLP's, then the encoder's."""
        return torch.cat((self.actor_body.folded(), self._encoder)).cpu().numpy()


def layer_sizes(policy: PolicySpec, critic_net: tuple[int, ...], outputs: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The layer sizes of the policy's actor, and of a critic with the hidden layers `critic_net` and this many outputs."""
    _, features = encoder_layout(policy)
    size = math.prod(policy.action.shape)
    return (features, *policy.net, 2 * size), (features + size, *critic_net, outputs)
