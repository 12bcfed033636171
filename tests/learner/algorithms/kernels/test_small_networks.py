"""A pass of a small network is that of the same network in torch: outputs, gradients, several calls in one loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from millrace.learner.algorithms.bodies import networks
from millrace.learner.algorithms.bodies.networks import ActorAndCritics, ActorCriticNetwork, FlatNetwork, QNetwork
from millrace.learner.algorithms.kernels import mlp as layers
from millrace.learner.algorithms.kernels import trained_networks
from millrace.learner.algorithms.kernels.trained_networks import SmallActorAndCritics, SmallActorCritic, SmallQNetwork
from millrace.protocol.action_parts import parts_of
from millrace.protocol.specs import ActionSpec, PolicySpec
from tests.protocol.policy.test_torch_policy import ACTIONS
from tests.support.examples import examples
from tests.support.numbers.batches import BOX, DISCRETE, GAUSSIAN, IMAGE, recurrent, shared
from tests.support.numbers.finite_differences import is_the_slope
from tests.support.numbers.rounding import assert_within, flat_gradient, in_double, in_float64, sampled
from tests.support.variants import variants

BOUNDED = ActionSpec("box", (2,), "float32", low=(-1.0,) * 2, high=(1.0,) * 2)
RELATIVE = 1e-7  # float64 has 1e-16; a few thousand additions, gradients that cancel, and 1 − tanh² near 0
ROUNDS = {"chunk": st.sampled_from([512, 7, 1]), "by_torch": st.booleans(), "seed": st.integers(0, 2**32)}


@pytest.fixture
def float64(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(networks, "DTYPE", torch.float64)
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(dtype)


def pair(kind: type[FlatNetwork], small: type[FlatNetwork], spec: PolicySpec, seed: int, scale: float) -> tuple[Any, Any]:
    """The same random network twice: in torch, and in numpy."""
    made = kind(spec), small(spec)
    weights = torch.tensor(np.random.default_rng(seed).normal(0, scale, len(made[0].flat)))
    for net in made:
        net.flat.copy_(weights)
    return made


def some_actions(spec: ActionSpec, rows: int, generator: np.random.Generator) -> Tensor:
    if spec.parts:
        drawn = [some_actions(part.spec, rows, generator).reshape(rows, -1) for part in parts_of(spec)]
        order = np.argsort([part.columns.start for part in parts_of(spec)])
        return torch.cat([drawn[i].to(torch.get_default_dtype()) for i in order], 1)
    if spec.kind == "box":
        return torch.tensor(generator.normal(size=(rows, *spec.shape)), dtype=torch.get_default_dtype())
    high = np.reshape(spec.sizes, spec.shape) if spec.sizes else 2
    return torch.tensor(generator.integers(0, high, (rows, *spec.shape)))


def numbers(generator: np.random.Generator, *shape: int) -> Tensor:
    return torch.tensor(generator.normal(size=shape), dtype=torch.get_default_dtype())


def is_the_same(found: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    """In float64, except for rounding."""
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=RELATIVE, atol=RELATIVE * theirs.abs().max().item())


def values_of(net: ActorCriticNetwork, x: Tensor) -> list[Tensor]:
    return [net.value(x)]


def backward(loss: Tensor, net: FlatNetwork) -> Tensor:
    """The gradient that a loss leaves in the network."""
    net.flat_grad.zero_()
    loss.backward()  # type: ignore[no-untyped-call]
    return net.flat_grad.clone()


# -------------------------------------------------------------------- an actor and a critic


class Rows(NamedTuple):
    """Rows of noise for an actor and a critic, or for action values."""

    x: Tensor  # [B, 4]
    action: Tensor  # [B, *action]
    by_outputs: list[Tensor]  # the gradient by each output

    @classmethod
    def of(cls, spec: PolicySpec, rows: int, seed: int) -> Rows:
        generator = np.random.default_rng(seed)
        shapes = [(rows, 4)] if spec.head == "q" else [(rows,)] * 3
        x, action = numbers(generator, rows, 4), some_actions(spec.action, rows, generator)
        return cls(x, action, [numbers(generator, *shape) for shape in shapes])

    def outcome(self, net: Any, gradient: Callable[[Tensor, Any], Tensor] = backward) -> list[Tensor]:
        """All outputs, the value alone, and the gradient."""
        if net.spec.head == "q":
            outputs = [net.params(self.x)]
        else:
            outputs = [*net.evaluate(self.x, (), None, self.action), net.value(self.x)]
        total = torch.stack([(by * each).sum() for by, each in zip(self.by_outputs, outputs, strict=False)]).sum()
        return [each.detach() for each in (*outputs, gradient(total, net))]

    def in_double(self) -> Rows:
        return Rows(in_double(self.x), in_double(self.action), [in_double(each) for each in self.by_outputs])


def networks_of(spec: PolicySpec, seed: int) -> tuple[Any, Any]:
    if spec.head == "q":
        return pair(QNetwork, SmallQNetwork, spec, seed, 0.4)
    return pair(ActorCriticNetwork, SmallActorCritic, spec, seed, 0.4)


def is_the_same_in_chunks(spec: PolicySpec, rows: int, seed: int, chunk: int, by_torch: bool) -> None:
    plain, small = networks_of(spec, seed)
    given_rows = Rows.of(spec, rows, seed)
    with patch.multiple(layers, CHUNK_ROWS=chunk, uses_torch=lambda _: by_torch):
        is_the_same(given_rows.outcome(small), given_rows.outcome(plain))


@pytest.mark.usefixtures("float64")
@given(
    st.sampled_from(sorted(ACTIONS)),
    st.sampled_from(["tanh", "relu"]),
    st.lists(st.integers(1, 9), max_size=3),
    st.booleans(),
    st.integers(1, 40),
    *ROUNDS.values(),
)
@examples(120)
def test_an_actor_and_a_critic(
    action: str, activation: Any, net: list[int], shared_net: bool, rows: int, chunk: int, by_torch: bool, seed: int
) -> None:
    spec = PolicySpec((BOX,), ACTIONS[action], tuple(net), activation, shared_net=shared_net)
    is_the_same_in_chunks(spec, rows, seed, chunk, by_torch)


@pytest.mark.usefixtures("float64")
@given(
    st.sampled_from(["tanh", "relu"]),
    st.lists(st.integers(1, 9), max_size=3),
    st.booleans(),
    st.integers(1, 40),
    *ROUNDS.values(),
)
@examples(100)
def test_action_values(
    activation: Any, net: list[int], dueling: bool, rows: int, chunk: int, by_torch: bool, seed: int
) -> None:
    spec = msgspec.structs.replace(DISCRETE, head="q", net=tuple(net), activation=activation, dueling=dueling)
    is_the_same_in_chunks(spec, rows, seed, chunk, by_torch)


VALUES = msgspec.structs.replace(DISCRETE, head="q", net=(64, 64))
WIDE = msgspec.structs.replace(VALUES, net=(256, 256))
SIZES = [
    *((PolicySpec((BOX,), action, (64, 64)), rows) for action in ACTIONS.values() for rows in (64, 129, 513, 2048)),
    *((msgspec.structs.replace(VALUES, dueling=dueling), rows) for dueling in (False, True) for rows in (64, 129)),
    *((msgspec.structs.replace(WIDE, dueling=dueling), rows) for dueling in (False, True) for rows in (513, 2048)),
]  # from 513 rows on there is more than one chunk


@pytest.mark.parametrize(
    ("spec", "rows"), [pytest.param(*each, marks=pytest.mark.soak if each[1] == 2048 else ()) for each in SIZES]
)
def test_the_sizes_that_are_used_in_float32(spec: PolicySpec, rows: int) -> None:
    plain, small = networks_of(spec, 0)
    given_rows = Rows.of(spec, rows, 0)
    exact, doubles = in_float64(plain), given_rows.in_double()
    found = given_rows.outcome(small), given_rows.outcome(plain)
    for expected, mine, theirs in zip(sampled(lambda: doubles.outcome(exact, flat_gradient)), *found, strict=True):
        expected.assert_is(mine.numpy(), theirs.numpy())


def test_the_tolerance_of_values_is_exceeded_if_a_single_term_is_lost() -> None:
    for net_size in ((), (5,), (64, 64)):
        plain, small = networks_of(PolicySpec((BOX,), ACTIONS["discrete"], net_size), 0)
        x = numbers(np.random.default_rng(0), 64, 4)
        before, ((_, tolerance),) = small.value(x).detach(), sampled(partial(values_of, in_float64(plain), x.double()))
        for name in [name for name in small.parameters if name.startswith("critic") and name.endswith("weight")]:
            with torch.no_grad():
                lost = small.parameters[name][0, -1].clone()
                small.parameters[name][0, -1] = 0
                assert (np.abs((small.value(x) - before).numpy()) > 10 * tolerance).mean() > 0.8, name
                small.parameters[name][0, -1] = lost


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("action", sorted(ACTIONS))
@pytest.mark.parametrize("shared_net", variants([False, True], default=[True]))
@pytest.mark.parametrize(("activation", "chunk", "by_torch"), [("tanh", 512, False), ("relu", 4, True)])
def test_the_gradient_of_an_actor_and_a_critic_is_the_slope(
    action: str, activation: Any, shared_net: bool, chunk: int, by_torch: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Central differences of a weighted sum of all outputs, by every parameter."""
    monkeypatch.setattr(layers, "CHUNK_ROWS", chunk)
    monkeypatch.setattr(layers, "uses_torch", lambda _: by_torch)
    generator = np.random.default_rng(3)
    spec = PolicySpec((BOX,), ACTIONS[action], (5, 3), activation, shared_net=shared_net)
    _, net = pair(ActorCriticNetwork, SmallActorCritic, spec, 3, 0.5)
    x, taken, weights = numbers(generator, 6, 4), some_actions(spec.action, 6, generator), numbers(generator, 3, 6)

    def total() -> Tensor:
        return torch.stack([(w * out).sum() for w, out in zip(weights, net.evaluate(x, (), None, taken), strict=True)]).sum()

    net.flat_grad.zero_()
    total().backward()  # type: ignore[no-untyped-call]
    is_the_slope(net.flat_grad.numpy().copy(), lambda: total().item(), net.flat.numpy(), 1e-6)


# -------------------------------------------------------------------- an actor and two critics


def everything_of(net: ActorAndCritics, seed: int, rows: int) -> list[Tensor]:
    """All outputs and gradients for random rows."""
    generator = np.random.default_rng(seed)
    x, action, noise = (numbers(generator, rows, size) for size in (4, 2, 2))
    taken, log_prob = net.sample(x, noise) if net.spec.head == "squashed" else (net.params(x).tanh(), net.params(x).sum(1))
    values = net.values(x, action)
    by_action = [net.values(x, taken, constant=True, critics=critics) for critics in (1, 2)]
    net.flat_grad.zero_()
    parts = (taken, log_prob, values, *by_action)
    loss: Tensor = sum((part * numbers(generator, *part.shape)).sum() for part in parts)  # type: ignore[assignment]
    loss.backward()  # type: ignore[no-untyped-call]
    return [each.detach() for each in (*parts, net.params(x), net.actor.grad, net.critics.grad) if each is not None]


@pytest.mark.usefixtures("float64")
@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=3),
    st.sampled_from(["relu", "tanh"]),
    st.sampled_from(["squashed", "deterministic"]),
    st.integers(1, 1100),
    st.integers(0, 999),
)
@examples(30)
def test_an_actor_and_two_critics(net: list[int], activation: Any, head: Any, rows: int, seed: int) -> None:
    """Weights are large, so that the logarithms of many standard deviations leave their bounds."""
    spec = PolicySpec((BOX,), BOUNDED, tuple(net), activation, head=head)
    plain, small = pair(ActorAndCritics, SmallActorAndCritics, spec, seed, 1.5)
    is_the_same(everything_of(small, seed, rows), everything_of(plain, seed, rows))


@pytest.mark.usefixtures("float64")
def test_standard_deviations_outside_their_bounds_get_no_gradient() -> None:
    spec = PolicySpec((BOX,), BOUNDED, (8,), "relu", head="squashed")
    _, net = pair(ActorAndCritics, SmallActorAndCritics, spec, 0, 0.0)
    net.parameters["actor.out.bias"].data[:] = torch.tensor([0.0, 0.0, 3.0, 1.0])
    _, log_prob = net.sample(torch.zeros(1, 4), torch.zeros(1, 2))
    assert net.params(torch.zeros(1, 4)).tolist() == [[0, 0, 2, 1]]
    log_prob.sum().backward()
    assert net.actor.grad[-2:].tolist() == [0, -1]


@pytest.mark.usefixtures("float64")
def test_a_squashed_sample_far_outside_is_finite() -> None:
    _, net = pair(ActorAndCritics, SmallActorAndCritics, PolicySpec((BOX,), BOUNDED, (8,), head="squashed"), 0, 0.0)
    net.parameters["actor.out.bias"].data[:] = torch.tensor([400.0, 400.0, 0.0, 0.0])
    action, log_prob = net.sample(torch.zeros(1, 4), torch.ones(1, 2))
    assert action.tolist() == [[1, 1]]
    assert log_prob.item() == pytest.approx(2 * (-0.5 - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - 401)))
    (action.sum() + log_prob.sum()).backward()
    assert torch.isfinite(net.actor.grad).all()


# -------------------------------------------------------------------- calls


def three_calls(net: ActorAndCritics, order: Sequence[int]) -> Tensor:
    """A loss of three calls of one size that depend on each other, added up in some order."""
    generator = np.random.default_rng(0)
    x, action = numbers(generator, 30, 4), numbers(generator, 30, 2)
    taken, values = net.params(x).tanh(), net.values(x, action)
    terms = [values.square().mean(), -net.values(x, taken).amin(0).mean(), net.values(x, 2 * action).exp().mean()]
    return terms[order[0]] + terms[order[1]] + terms[order[2]]


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_a_loss_may_contain_several_calls(order: Sequence[int]) -> None:
    spec = PolicySpec((BOX,), BOUNDED, (8, 5), "relu", head="deterministic")
    nets = pair(ActorAndCritics, SmallActorAndCritics, spec, 0, 0.5)
    for _ in range(2):  # the second one finds arrays that were used before
        for net in nets:
            net.flat_grad.zero_()
            three_calls(net, order).backward()  # type: ignore[no-untyped-call]
        plain, small = (net.flat_grad for net in nets)
        is_the_same([small], [plain])


def test_a_pass_without_a_gradient_leaves_the_arrays_of_one_whose_backward_is_to_come() -> None:
    _, net = pair(ActorCriticNetwork, SmallActorCritic, DISCRETE, 0, 0.4)
    x = numbers(np.random.default_rng(0), 30, 4)
    gradients = []
    for disturbed in (False, True):
        net.flat_grad.zero_()
        value = net.value(x)
        if disturbed:
            with torch.no_grad():
                assert not torch.equal(net.value(10 * x), value)
            assert not net.value(x, ()).equal(net.value(2 * x))
        value.sum().backward()
        gradients.append(net.flat_grad.clone())
    assert torch.equal(*gradients)
    assert gradients[0].any()


def test_results_are_not_overwritten_by_the_next_call() -> None:
    _, net = pair(ActorCriticNetwork, SmallActorCritic, DISCRETE, 0, 0.4)
    x = numbers(np.random.default_rng(0), 30, 4)
    with torch.no_grad():
        value = net.value(x)
        kept = value.clone()
        net.value(2 * x)
    assert torch.equal(value, kept)
    gradients = [torch.autograd.grad(net.value(each).sum(), net._critic_alone._parameters)[0] for each in (x, 2 * x)]
    assert not torch.equal(*gradients)


def twice(net: Any, x: Tensor) -> None:
    loss = net.value(x).sum()
    loss.backward(retain_graph=True)
    loss.backward()


def double(net: Any, x: Tensor) -> None:
    net.value(x).sum().backward(create_graph=True)


def changed_before(net: Any, x: Tensor) -> None:
    loss = net.value(x).sum()
    net.flat.mul_(2)
    loss.backward()


@pytest.mark.parametrize(
    ("mistake", "line"),
    [
        (twice, "backward was called twice through the same outputs of a network, which keeps what it needs for one"),
        (double, "in numpy, which has no second derivatives; call backward without create_graph"),
        (changed_before, "modified by an inplace operation"),
    ],
)
def test_what_a_pass_cannot_do_is_an_error(mistake: Callable[[Any, Tensor], None], line: str) -> None:
    _, net = pair(ActorCriticNetwork, SmallActorCritic, DISCRETE, 0, 0.4)
    with pytest.raises(RuntimeError, match=line) as found:
        mistake(net, numbers(np.random.default_rng(0), 30, 4))
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("network", [ActorCriticNetwork, ActorAndCritics])
def test_a_network_that_is_not_small_has_no_second_derivative_either(network: Any) -> None:
    """Its MLP is one operation, too. Without an error, what its gradient depends on would be missing."""
    spec = msgspec.structs.replace(GAUSSIAN, head="squashed") if network is ActorAndCritics else DISCRETE
    net, x = network(spec), numbers(np.random.default_rng(0), 30, 4).requires_grad_()
    value = net.values(x, torch.zeros(30, 2)) if network is ActorAndCritics else net.value(x)
    with pytest.raises(RuntimeError, match="no second derivatives; call backward without create_graph"):
        torch.autograd.grad(value.sum(), x, create_graph=True)


# -------------------------------------------------------------------- when, and what it takes


@pytest.mark.parametrize(
    ("spec", "device", "expected"),
    [
        (DISCRETE, "cpu", True),
        (DISCRETE, "cuda", False),
        (shared(GAUSSIAN), "cpu", True),
        (IMAGE, "cpu", False),
        (recurrent(DISCRETE, "gru"), "cpu", False),
        (msgspec.structs.replace(DISCRETE, head="q"), "cpu", True),
        (msgspec.structs.replace(DISCRETE, net=(64, 256)), "cpu", True),
        (msgspec.structs.replace(DISCRETE, net=(64, 257)), "cpu", False),
    ],
)
def test_small_is_a_matter_of_shape_and_device(spec: PolicySpec, device: str, expected: bool) -> None:
    assert trained_networks.is_small(spec, device) == expected


def test_critics_without_a_hidden_layer_are_not_small() -> None:
    spec = PolicySpec((BOX,), BOUNDED, (), head="squashed")
    assert type(trained_networks.actor_and_critics(spec, "cpu", 0)) is ActorAndCritics
    assert (
        type(trained_networks.actor_and_critics(msgspec.structs.replace(spec, net=(4,)), "cpu", 0)) is SmallActorAndCritics
    )


def test_sizes_of_minibatches_come_and_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layers, "MAX_PLANS", 30)
    plain, net = pair(ActorCriticNetwork, SmallActorCritic, msgspec.structs.replace(DISCRETE, net=(5,)), 0, 0.4)
    x = numbers(np.random.default_rng(0), 99, 4)
    exact = in_float64(plain)
    ((_, tolerance),) = sampled(lambda: [exact.value(x.double())])
    with torch.no_grad():
        whole = net.value(x).numpy()
        for rows in (*range(1, 99), 40, 2):
            assert_within(net.value(x[:rows]).numpy(), whole[:rows], tolerance[:rows])
            (workspace,) = net._critic_alone._free
            assert len(workspace._plans) <= 30
    assert {40, 2} <= set(workspace._plans)


def test_sizes_of_minibatches_share_their_memory() -> None:
    """And give the bits that they would give alone, whichever came before."""
    spec = PolicySpec((BOX,), ACTIONS["discrete"], (32,))
    _, used = pair(ActorCriticNetwork, SmallActorCritic, spec, 0, 0.4)
    x = numbers(np.random.default_rng(0), 2 * layers.CHUNK_ROWS, 4)
    for rows in (200, 256, 255, 2 * layers.CHUNK_ROWS, 256, 1, 255):
        _, alone = pair(ActorCriticNetwork, SmallActorCritic, spec, 0, 0.4)
        bits = []
        for net in (alone, used):
            net.flat_grad.zero_()
            outputs = net.evaluate(x[:rows], (), None, torch.zeros(rows, dtype=torch.int64))
            torch.autograd.backward(outputs, [torch.ones(rows)] * 3)
            bits.append([*outputs, net.flat_grad])
        for one, other in zip(*bits, strict=True):
            assert torch.equal(one, other)
    (workspace,) = used._both._free
    assert np.shares_memory(workspace._plans[256].head_outputs[0], workspace._plans[255].head_outputs[0])
    assert sum(array.nbytes for array in workspace._arrays) < 3 * 4 * 2 * layers.CHUNK_ROWS * (4 + 4 * 32 * 2)
