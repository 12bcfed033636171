"""Features: one-hot without a square, small images flattened, float64 observations normalized before they are rounded."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithms.minibatches import log_probs
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.running_statistics import ObservationNormalizer
from millrace.learner.algorithms.xqc import XQC
from millrace.learner.config.hyperparameters import PPOConfig, XQCConfig
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import observation_leaves
from millrace.protocol.policy.features import feature_size, features
from millrace.protocol.policy.layout import acting_size, buffer_size, convolutions
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rollout import stack_rollouts
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.docs.pages import blocks, written
from tests.support.envs.toy import Countdown
from tests.support.in_process.collectors import collect, loop_over, random_collector, run_around
from tests.support.in_process.saved_policies import policy_run
from tests.support.numbers.batches import GAUSSIAN, batch, no_pulse

TWO = ActionSpec("discrete", (), "int64", (2,), (0,))
IMAGE = gymnasium.spaces.Box(0, 255, (12, 12, 3), np.uint8)


def policy_of(space: gymnasium.Space[Any], **settings: Any) -> PolicySpec:
    return PolicySpec(observation_leaves(space), TWO, **settings)


# ------------------------------------------------------------------------------------------------ one-hot


@pytest.mark.parametrize(
    "space",
    [
        gymnasium.spaces.Discrete(1),
        gymnasium.spaces.Discrete(500),
        gymnasium.spaces.Discrete(7, start=-3),
        gymnasium.spaces.MultiDiscrete([3, 1, 4], start=[-1, 0, 5]),
        gymnasium.spaces.MultiDiscrete(np.array([[2, 3], [4, 5]])),
    ],
    ids=str,
)
def test_one_hot_features_are_rows_of_the_identity_side_by_side(space: Any) -> None:
    spec = policy_of(space)
    (leaf,) = spec.observation
    rows = np.stack([space.sample() for _ in range(6 * 5)]).reshape(6, 5, *leaf.shape)
    counted = (rows - np.reshape(leaf.start, leaf.shape)).reshape(6, 5, -1)
    identities = [np.eye(n, dtype=np.float32)[counted[..., i]] for i, n in enumerate(leaf.sizes)]
    assert features(spec, [rows]).tobytes() == np.concatenate(identities, -1).tobytes()
    assert features(spec, [rows]).dtype == np.float32


@pytest.mark.parametrize("space", [gymnasium.spaces.Discrete(100_000), gymnasium.spaces.MultiDiscrete([4] * 25_000)])
def test_one_hot_features_take_no_more_memory_than_their_result(space: Any) -> None:
    spec = policy_of(space)
    rows = space.sample()[None, None] if isinstance(space, gymnasium.spaces.MultiDiscrete) else np.zeros((1, 1), np.int64)
    features(spec, [rows])
    tracemalloc.start()
    found = features(spec, [rows])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.nbytes == 400_000
    assert peak < 6 * found.nbytes


# ------------------------------------------------------------------------------------------------ bytes


def bounds(*values: int) -> Any:
    return np.array(values, np.uint8)


@pytest.mark.parametrize(
    ("low", "high", "divisor"),
    [
        (0, 255, 255),
        (0, 1, 1),
        (0, 254, 1),
        (1, 255, 1),
        (bounds(0, 0, 0, 0), bounds(255, 255, 255, 255), 255),
        (bounds(0, 0, 0, 0), bounds(255, 255, 255, 1), 1),
    ],
    ids=str,
)
@pytest.mark.parametrize("normalized", [False, True])
def test_bytes_are_divided_where_their_bounds_say_so_and_else_are_numbers_as_any_other(
    low: Any, high: Any, divisor: int, normalized: bool
) -> None:
    shape = () if isinstance(low, np.ndarray) else (4,)
    spec = policy_of(gymnasium.spaces.Box(low, high, shape or None, np.uint8), normalize_observations=normalized)
    rows = np.arange(256, dtype=np.uint8).reshape(2, 32, 4)
    found = features(spec, [rows])
    assert found.dtype == np.float32
    expected = rows * np.float32(1 / 255) if divisor == 255 else rows.astype(np.float32)
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("shape", [(8, 8, 2), (36, 40, 1)])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_planes_of_0_and_1_reach_the_convolutions_as_they_are(shape: tuple[int, ...], precision: Any) -> None:
    """Those of 0 and 255 reach them as the same numbers."""
    planes, picture = (policy_of(gymnasium.spaces.Box(0, high, shape, np.uint8)) for high in (1, 255))
    rows = np.random.default_rng(0).integers(0, 2, (1, 5, *shape), np.uint8)
    parameters = np.random.default_rng(1).normal(0, 0.1, acting_size(planes)).astype(np.float32)
    found = []
    for spec, seen in ((planes, rows), (picture, rows * np.uint8(255))):
        policy = make_policy(spec, precision)
        policy.load(parameters, np.zeros(0, np.float32))
        found.append(policy([seen]))
    if precision == "float32":
        assert found[0].tobytes() == found[1].tobytes()  # 255 times float32(1/255) is 1
    else:
        # The first weights are rounded once more, to 8 bits. The outputs are sums of many of them, of the size of 1.
        np.testing.assert_allclose(found[0], found[1], atol=0.1)
        assert np.abs(found[0]).max() > 0.1


def exported_actor(run: Path) -> Any:
    """The TorchScript module of docs/how-to/policies.md."""
    (code,) = (block.text for block in blocks(written()["docs/how-to/policies.md"]) if "class Actor" in block.text)
    names: dict[str, Any] = {}
    exec(code.partition("\nactor = ")[0], names)
    return names["Actor"](run)


@pytest.mark.parametrize(("dtype", "high"), [("uint8", 1), ("uint8", 255), ("int8", 1), ("float32", 1)])
def test_the_exported_actor_of_the_page_sees_what_the_policy_sees(dtype: str, high: int, tmp_path: Path) -> None:
    spec = policy_of(gymnasium.spaces.Box(0, high, (4,), np.dtype(dtype).type), normalize_observations=True)
    generator = np.random.default_rng(0)
    weights = generator.normal(0, 0.5, acting_size(spec)).astype(np.float32), np.ones(buffer_size(spec), np.float32)
    RunFolder(tmp_path).write_policy(policy_run(spec, EnvSpec("Mine-v0")), *weights)
    policy = make_policy(spec)
    policy.load(*weights)
    rows = generator.integers(0, high + 1, (1, 20, 4)).astype(dtype)
    found = exported_actor(tmp_path)(torch.from_numpy(rows[0]))
    # A hundred float32 operations on numbers of the size of 1, in another order.
    np.testing.assert_allclose(found.numpy(), policy([rows])[0], atol=1e-4)


def test_the_exported_actor_of_the_page_acts_as_xqc_does_which_normalizes_in_training(tmp_path: Path) -> None:
    """Its statistics are folded into the layers of policy.safetensors."""
    config = XQCConfig(net=(16, 16), critic_net=(16,), learning_starts=0, updates_per_step=0.1)
    box = msgspec.structs.replace(GAUSSIAN.action, low=(-2.0,) * 2, high=(2.0,) * 2)
    algorithm = XQC(config, XQC.policy_spec(config, GAUSSIAN.observation, box), total_steps=1000, seed=0)
    algorithm.update(batch(algorithm, 0), no_pulse)
    RunFolder(tmp_path).write_policy(policy_run(algorithm.policy, EnvSpec("Mine-v0")), *algorithm.weights())
    x = torch.randn(20, 4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = algorithm.net.params(x)
    torch.testing.assert_close(exported_actor(tmp_path)(x), expected, atol=1e-4, rtol=1e-4)


# ------------------------------------------------------------------------------------------------ images


@pytest.mark.parametrize(
    ("shape", "is_image"),
    [
        ((5, 5, 3), True), ((3, 5, 5), True), ((5, 40, 1), True), ((36, 36, 4), True), ((35, 90, 4), True),
        ((4, 5, 3), False), ((5, 4, 3), False), ((3, 4, 9), False), ((2, 9, 4), False), ((1, 1, 1), False),
        ((4, 84, 84), True), ((84, 84, 100), True), ((84, 3, 100), False),
    ],
)  # fmt: skip
def test_an_image_whose_side_is_too_small_for_the_convolutions_is_flattened(shape: tuple[int, ...], is_image: bool) -> None:
    leaf = Leaf("", "box", shape, "uint8", divisor=255)
    assert leaf.is_image is is_image
    spec = PolicySpec((leaf,), TWO)
    if is_image:
        assert convolutions(leaf)[2] > 0
    else:
        assert feature_size(spec) == np.prod(shape)
        assert not spec.needs_torch
    image = np.full((2, 3, *shape), 255, np.uint8)
    policy = make_policy(spec)
    policy.load(np.full(acting_size(spec), 0.01, np.float32), np.zeros(0, np.float32))
    params = policy([image])
    assert params.shape == (2, 3, 2)
    assert (params != 0).all()


# ------------------------------------------------------------------------------------------------ float64


class Clock(Countdown):
    """Shows a large time that differs by less than float32 can tell from one step to the next."""

    START = 2.0**20  # float32 has steps of 0.125 here
    STEP = 0.05

    def __init__(self) -> None:
        super().__init__(100)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)  # type: ignore[arg-type]

    def _observation(self) -> Any:
        return np.array([self.START + self.STEP * self._left, self._left])


def test_a_float64_observation_keeps_the_digits_by_which_it_differs_from_the_mean() -> None:
    spec = policy_of(Clock().observation_space, normalize_observations=True)
    x = np.array([[[Clock.START + 0.05, 1.0], [Clock.START + 0.1, 2.0]]])
    mean, std = np.array([Clock.START, 1.5], np.float32), np.array([0.05, 0.5], np.float32)
    found = normalize(features(spec, [x]), mean, std)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [[[1.0, -1.0], [2.0, 1.0]]], rtol=1e-6)


@pytest.mark.parametrize("dtype", ["int32", "uint32", "int64", "uint64"])
def test_so_do_whole_numbers_that_float32_cannot_tell_apart(dtype: str) -> None:
    now = 1_700_000_000  # seconds since 1970: float32 has steps of 128 here
    kind: Any = np.dtype(dtype).type
    spec = policy_of(gymnasium.spaces.Box(0, 2**31 - 1, (1,), kind), normalize_observations=True)
    x = np.arange(now, now + 100, dtype=kind)[:, None, None]
    normalizer = ObservationNormalizer(spec)
    normalizer.update(features(spec, [x]), np.ones((100, 1), bool))
    found = normalize(features(spec, [x]), *np.split(normalizer.buffers(), 2))
    assert len(np.unique(found)) == 100


def test_statistics_of_float64_observations_are_those_of_all_their_digits() -> None:
    spec = policy_of(Clock().observation_space, normalize_observations=True)
    normalizer = ObservationNormalizer(spec)
    x = np.stack([Clock.START + 0.05 * np.arange(100), np.arange(100)], -1)[:, None]
    normalizer.update(features(spec, [x]), np.ones((100, 1), bool))
    mean, std = np.split(normalizer.buffers(), 2)  # the mean of a clock is rounded to float32
    np.testing.assert_allclose(std, np.sqrt(np.square(x[:, 0] - mean.astype(np.float64)).mean(0)), rtol=1e-6)


def test_only_a_policy_that_normalizes_keeps_float64_and_only_until_then() -> None:
    x = [np.linspace(-1, 1, 6).reshape(1, 3, 2)]
    spec = policy_of(Clock().observation_space)
    assert features(spec, x).tobytes() == x[0].astype(np.float32).tobytes()
    single = PolicySpec((Leaf("", "box", (2,), "float32"),), TWO, normalize_observations=True)
    assert features(single, [x[0].astype(np.float32)]).dtype == np.float32


def test_learner_and_worker_see_the_same_numbers_of_float64_observations() -> None:
    """After an update has moved the statistics, the probability ratio before the next step is 1."""
    run = run_around(Clock(), T=128)
    policy = msgspec.structs.replace(run.policy, normalize_observations=True)
    run = msgspec.structs.replace(run, policy=policy, copies=4)
    learner = PPO(PPOConfig(n_epochs=1, batch_size=128), policy, total_steps=10_000, seed=0)
    collector = random_collector(run, loop_over([Clock] * 4))
    for k in range(3):
        collector.load(*learner.weights())
        batch = stack_rollouts(collect(collector, run, k))
        seen = learner.observations(batch)
        worker = normalize(features(policy, batch.obs), *np.split(learner.weights()[1], 2))
        assert worker.tobytes() == seen.features.numpy().tobytes()
        assert k == 0 or len(np.unique(worker[..., 0])) > 95  # else the digits were lost on both sides
        mask = batch.valid
        np.testing.assert_array_equal(
            np.exp(log_probs(learner.net, seen, batch, lambda: None)[mask] - batch.log_prob[mask]).round(6), 1
        )
        learner.update(batch, lambda: None)
