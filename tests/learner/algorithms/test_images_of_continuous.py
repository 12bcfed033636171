"""Images for algorithms of continuous actions: the random shift, who trains the encoder, and who acts with it."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.replay.random_shift import random_shift
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.policy.torch_policy import TorchPolicy
from tests.support.numbers.batches import GAUSSIAN, IMAGE, batch, no_pulse

ALGORITHMS = ("sac", "td3", "tqc", "crossq", "xqc")
SEEN = msgspec.structs.replace(IMAGE, action=GAUSSIAN.action)


def made(algo: str, **settings: Any) -> Any:
    keywords: dict[str, Any] = {"net": (16,), "batch_size": 32, "learning_starts": 0, "replay_size": 500, **settings}
    if algo in ("crossq", "xqc"):
        keywords["critic_net"] = (16,)
    kind: Any = algorithm_class(algo)
    config = msgspec.convert(keywords, HYPERPARAMETERS[algo])
    policy = kind.policy_spec(config, SEEN.observation, SEEN.action)
    return kind(config, policy, total_steps=10_000, seed=1)


def drawn(algorithm: Any) -> Any:
    """Transitions of a batch, encoded."""
    algorithm.replay.add(batch(algorithm, 0))
    return algorithm.transitions(algorithm.replay.sample(32))


# -------------------------------------------------------------------- the random shift


@pytest.mark.parametrize("channels_last", [True, False])
def test_each_image_moves_by_whole_pixels_and_repeats_its_border(channels_last: bool) -> None:
    """Pixels are numbered, so that the pixel in each place tells where it came from."""
    height, width, most = 5, 7, 2
    rows, columns = np.mgrid[:height, :width]
    numbered = np.stack([rows, columns], -1).astype(np.uint8)  # two channels
    images = torch.from_numpy(np.stack([numbered] * 400))
    moved = random_shift(
        images if channels_last else images.movedim(3, 1),
        most,
        channels_last=channels_last,
        generator=torch.Generator().manual_seed(0),
    )
    found = (moved if channels_last else moved.movedim(1, 3)).numpy().astype(int)
    middle = found[:, height // 2, width // 2] - [height // 2, width // 2]  # [400, 2] the move of each image
    for image, (down, right) in zip(found, middle, strict=True):
        expected = np.stack([(rows + down).clip(0, height - 1), (columns + right).clip(0, width - 1)], -1)
        np.testing.assert_array_equal(image, expected)
    for moves in middle.T:
        counts = np.bincount(moves + most, minlength=2 * most + 1)
        expected_count = 400 / (2 * most + 1)
        assert np.abs(counts - expected_count).max() < 5 * np.sqrt(expected_count), "five standard deviations"
    assert np.abs(np.corrcoef(middle.T)[0, 1]) < 5 / np.sqrt(400), "the directions are independent"


def test_without_a_shift_no_random_number_is_drawn() -> None:
    images = torch.arange(48, dtype=torch.uint8).reshape(1, 4, 4, 3)
    generator = torch.Generator().manual_seed(3)
    before = generator.get_state()
    assert random_shift(images, 0, channels_last=True, generator=generator) is images
    assert torch.equal(generator.get_state(), before)


# -------------------------------------------------------------------- who trains the encoder


def encoder_of(net: Any, values: Tensor) -> Tensor:
    """The part of `values`, which are like `flat`, that belongs to the encoder."""
    return values[len(net.actor) : net.acting_size]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_critics_train_the_encoder_and_the_actor_does_not(algo: str) -> None:
    algorithm = made(algo)
    rows = drawn(algorithm)
    net = algorithm.net
    loss = algorithm.critic_loss(rows)
    optimizer = algorithm.optimizers["critic_optimizer"]
    algorithm.differentiate(loss.loss, optimizer, {})
    of_critics = encoder_of(net, net.flat_grad).clone()
    assert of_critics.abs().sum() > 0
    assert len(encoder_of(net, net.flat)) > 1000
    loss = algorithm.actor_loss(rows.x.detach())
    algorithm.differentiate(loss if algo == "td3" else loss[0], algorithm.optimizers["actor_optimizer"], {})
    assert torch.equal(encoder_of(net, net.flat_grad), of_critics)
    assert not rows.next_x.requires_grad


@pytest.mark.parametrize("algo", ["sac", "td3", "tqc"])
def test_the_encoder_s_gradient_is_the_slope_of_the_critics_loss(algo: str) -> None:
    """Against differences in a random direction. Targets are fixed: they depend on the encoder, too."""
    algorithm = made(algo, random_shift=0)
    algorithm.replay.add(batch(algorithm, 0))
    sample = algorithm.replay.sample(32)
    targets = algorithm.targets(algorithm.transitions(sample))
    algorithm.targets = lambda rows: targets

    def loss() -> Tensor:
        found: Tensor = algorithm.critic_loss(algorithm.transitions(sample)).loss
        return found

    algorithm.differentiate(loss(), algorithm.optimizers["critic_optimizer"], {})
    net = algorithm.net
    direction = torch.zeros_like(net.flat)
    encoder_of(net, direction)[-1000:].normal_(generator=torch.Generator().manual_seed(0))  # of the layer after convolutions
    slope = float((net.flat_grad * direction).sum())
    step = 1e-3
    values = []
    for sign in (1, -1):
        net.flat.add_(direction, alpha=sign * step)
        with torch.no_grad():
            values.append(float(loss()))
        net.flat.sub_(direction, alpha=sign * step)
    assert (values[0] - values[1]) / (2 * step) == pytest.approx(slope, rel=0.02)  # ReLUs bend between the two


# -------------------------------------------------------------------- who acts with it


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_workers_see_what_the_learner_sees(algo: str) -> None:
    algorithm = made(algo, updates_per_step=0.1)
    rows = batch(algorithm, 0)
    algorithm.update(rows, no_pulse)
    policy = TorchPolicy(algorithm.policy)
    policy.load(*algorithm.weights())
    leaves = [leaf[:1] for leaf in rows.obs]
    found = policy(leaves)[0]
    with torch.no_grad():
        expected = algorithm.net.params(*algorithm.inputs([leaf[0] for leaf in leaves])).numpy()
    np.testing.assert_allclose(found[:, : expected.shape[1]], expected, rtol=1e-4, atol=1e-4)


def test_an_encoder_of_the_user_s_own_is_trained_by_the_critics() -> None:
    kind: Any = algorithm_class("sac")
    config = msgspec.convert({"net": (16,), "batch_size": 32, "replay_size": 500}, HYPERPARAMETERS["sac"])
    encoder = describe_encoder("tests.support.users_code.custom_encoders:mixer", SEEN.observation, SEEN.action)
    policy = msgspec.structs.replace(kind.policy_spec(config, SEEN.observation, SEEN.action), encoder=encoder)
    algorithm = kind(config, policy, total_steps=1000, seed=1)
    rows = drawn(algorithm)
    algorithm.differentiate(algorithm.critic_loss(rows).loss, algorithm.optimizers["critic_optimizer"], {})
    assert encoder_of(algorithm.net, algorithm.net.flat_grad).abs().sum() > 0
