"""A module of the user's own: its parameters are the policy's, it learns, acts and is saved like any other layer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork, QNetwork
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.env_spec import AllowedCode, EnvSpec
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.encoder import RecurrentInput
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.policy.own_encoder import describe_encoder, make_encoder
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.policy.torch_policy import TorchPolicy
from millrace.protocol.specs import Leaf, NamedShape, PolicySpec
from tests.support.in_process.described import run_spec
from tests.support.in_process.saved_policies import load_policy, policy_run
from tests.support.numbers.batches import DISCRETE, IMAGE, batch, no_pulse, recurrent
from tests.support.numbers.rounding import in_float64, sampled

HERE = "tests.support.users_code.custom_encoders"


def encoded(spec: PolicySpec, name: str = "mixer") -> PolicySpec:
    return msgspec.structs.replace(spec, encoder=describe_encoder(f"{HERE}:{name}", spec.observation, spec.action))


@pytest.mark.parametrize("spec", [DISCRETE, IMAGE, recurrent(IMAGE, "lstm")])
def test_its_parameters_are_views_of_the_flat_ones_and_keep_their_first_values(spec: PolicySpec) -> None:
    spec = encoded(spec)
    net = ActorCriticNetwork(spec, seed=3)
    alone = make_encoder(spec, seed=3)
    assert not [field for field in net.fields if field.name.startswith("image")]
    for name, parameter in alone.named_parameters():
        ours = net.parameters[f"encoder.{name}"]
        assert torch.equal(ours, parameter)
        assert ours.untyped_storage().data_ptr() == net.flat.untyped_storage().data_ptr()
        assert ours.grad is not None
        assert ours.grad.untyped_storage().data_ptr() == net.flat_grad.untyped_storage().data_ptr()
    assert sum(map(torch.numel, net.parameters.values())) == len(net.flat)
    assert not torch.equal(net.flat, ActorCriticNetwork(spec, seed=4).flat)
    x = torch.randn(6, 4)
    images = [torch.randint(0, 256, (6, *leaf.shape), dtype=torch.uint8) for leaf in spec.observation[1:]]
    expected = alone(x, *images)
    if spec.core is not None:
        expected, _ = net.encode.core(expected, RecurrentInput(torch.zeros(6, spec.state_size), torch.ones(1, 6)))
    assert torch.equal(net.encode(x, images), expected)
    net.encode(x, images).square().sum().backward()  # type: ignore[no-untyped-call]
    assert (net.flat_grad != 0).any()
    net.flat.mul_(2)
    assert not torch.allclose(net.encode(x, images), expected)


@pytest.mark.parametrize("name", ["ppo", "a2c", "impala", "reinforce"])
def test_it_learns_with_the_rest(name: str) -> None:
    spec = encoded(IMAGE)
    algorithm: Any = algorithm_class(name)(HYPERPARAMETERS[name](), spec, total_steps=1000, seed=0)
    before = {field: tensor.detach().clone() for field, tensor in algorithm.net.parameters.items()}
    algorithm.update(batch(algorithm, 0), no_pulse)
    for field, tensor in algorithm.net.parameters.items():
        if not field.endswith(".bias"):
            assert not torch.equal(tensor, before[field]), field
    assert algorithm.weights()[0].shape == (acting_size(spec),)


@pytest.mark.parametrize("spec", [DISCRETE, recurrent(DISCRETE, "gru"), msgspec.structs.replace(DISCRETE, head="q")])
def test_acting_with_it_is_learning_with_it(spec: PolicySpec) -> None:
    spec = encoded(spec)
    net = (QNetwork if spec.head == "q" else ActorCriticNetwork)(spec, seed=1)
    policy = make_policy(spec)
    assert isinstance(policy, TorchPolicy)
    policy.load(net.flat.numpy()[: net.acting_size], np.zeros(int(spec.head == "q"), np.float32))
    obs = np.random.default_rng(0).normal(size=(2, 3, 4)).astype(np.float32)
    x = torch.tensor(obs).flatten(0, 1)
    exact = in_float64(net)
    (expected,) = sampled(lambda: [exact.params(x.double())])
    with torch.no_grad():
        expected.assert_is(net.params(x).numpy(), policy([obs])[..., :4].reshape(6, 4))


def test_one_that_is_different_here_is_refused() -> None:
    spec = encoded(DISCRETE)
    assert spec.encoder is not None
    first, *rest = spec.encoder.arrays
    other = msgspec.structs.replace(spec.encoder, arrays=(NamedShape(first.name, (7, 4)), *rest))
    with pytest.raises(UsageError, match=rf"parameter {first.name}: expected \(7, 4\) as the learner has it, got \(12, 4\)"):
        ActorCriticNetwork(msgspec.structs.replace(spec, encoder=other))
    more = msgspec.structs.replace(spec.encoder, arrays=(*spec.encoder.arrays, NamedShape("more", (1,))))
    with pytest.raises(UsageError, match=r"parameter more: expected \(1,\) as the learner has it, got none"):
        ActorCriticNetwork(msgspec.structs.replace(spec, encoder=more))


@pytest.mark.parametrize(
    ("factory", "says"),
    [
        ("nowhere", "encoder nowhere: expected module:factory, as in my_package.networks:encoder"),
        ("no.such:one", "no module named no; is it installed, or its folder on PYTHONPATH?"),
        (f"{HERE}:one", "module tests.support.users_code.custom_encoders has no one"),
        (f"{HERE}:not_a_module", "expected it to return a torch.nn.Module, got int"),
        (f"{HERE}:with_statistics", "expected only parameters, got the buffer 1.running_mean; use LayerNorm, say"),
        (f"{HERE}:of_doubles", "expected float32 parameters, got another dtype in weight"),
        (f"{HERE}:of_one_dimension", r"expected float32[2, K] of two observations, got torch.float32[2]"),
        (f"{HERE}:wants_more", "raised RuntimeError: mat1 and mat2 shapes cannot be multiplied"),
        (f"{HERE}:wants_more", "; its factory got features=4, images=[]"),
        (f"{HERE}:raises", "cannot be made: OSError: no such file; its factory got features=4, images=[]"),
    ],
)
def test_one_that_cannot_be_used_is_refused_in_one_line(factory: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        describe_encoder(factory, DISCRETE.observation, DISCRETE.action)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_it_is_said_that_a_stack_of_images_is_no_image() -> None:
    stack = Leaf("view", "box", (3, 24, 24, 3), "uint8")
    with pytest.raises(UsageError) as caught:
        describe_encoder(f"{HERE}:raises", (stack,), DISCRETE.action)
    assert str(caught.value).endswith(
        "; its factory got features=5184, images=[]; observation view uint8[3, 24, 24, 3] has four dimensions, so it isn't "
        'an image: stack the images along the channels (--wrappers "millrace:StackImages(n=3)")'
    )


def test_one_without_parameters_will_do() -> None:
    spec = encoded(DISCRETE, "nothing_to_learn")
    assert spec.encoder is not None
    assert (spec.encoder.arrays, spec.encoder.size) == ((), 4)
    ActorCriticNetwork(spec)


def test_a_setting_names_it_and_a_run_folder_keeps_it(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", encoder=f"{HERE}:mixer", run_dir=str(tmp_path), algo="dqn")
    spec = run_spec(config, EnvSpec("CartPole-v1")).policy
    assert spec.encoder is not None
    assert spec.encoder.size == 12
    net, folder = QNetwork(spec), RunFolder.create(config)
    folder.write_policy(policy_run(spec, EnvSpec("CartPole-v1")), net.flat.numpy(), np.zeros(1, np.float32))
    policy, found, _ = load_policy(folder.path)
    assert found == spec
    obs = np.ones((1, 1, 4), np.float32)
    exact = in_float64(net)
    (expected,) = sampled(lambda: [exact.params(torch.tensor(obs[0]).double())])
    expected.assert_is(policy([obs])[0, :, :2])


def test_only_a_worker_that_knows_its_learner_calls_an_encoder() -> None:
    run = run_spec(resolve("CartPole-v1", encoder=f"{HERE}:mixer"), EnvSpec("CartPole-v1"))
    for code in (AllowedCode.REGISTERED, AllowedCode.MODULES):
        assert run.rejection_reason(code).startswith(f"encoder {HERE}:mixer is a function or a class to call")
    assert run.rejection_reason(AllowedCode.CALLABLES) == ""
    assert msgspec.structs.replace(run, policy=DISCRETE).rejection_reason(AllowedCode.REGISTERED) == ""
