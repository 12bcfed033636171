"""Prior transitions: the share that is asked for, never changed, never ranked, and drawn on as if nothing had happened."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch

from millrace.learner.algorithms.replay import mixed_replay
from millrace.learner.algorithms.replay.mixed_replay import PRIOR_SLOT, MixedReplay
from millrace.protocol.errors import UsageError
from tests.learner.algorithms.replay.test_replay import GAMMA, OBS, Lanes, replay

SHARE = 0.25


def mixed(own: int = 4, prior: int = 6, alpha: float | None = None, share: float = SHARE) -> tuple[MixedReplay, set[float]]:
    """A replay with so many rollouts of its own and of prior data; and the first observations of the prior ones."""
    made = MixedReplay(OBS, size=1000, n_step=1, gamma=GAMMA, seed=0, alpha=alpha)
    lanes = Lanes(1)
    before = Lanes(2)
    before_rows = [before.used(before.rollout(0)) for _ in range(prior)]
    for batch in before_rows:  # observations of prior data are negative
        batch.obs[0][...] *= -1
    if prior:
        made.add_prior(before_rows, 500, share)
    for _ in range(own):
        made.add(lanes.used(lanes.rollout(0)))
    return made, {-began for began in before.rows}


def firsts(drawn: Any) -> Any:
    return drawn.leaves[0][:, 0]


@pytest.mark.parametrize(("count", "expected"), [(8, 2), (100, 25), (1, 0), (6, 2)])
def test_each_draw_has_the_share_of_prior_transitions(count: int, expected: int) -> None:
    made, before = mixed()
    for _ in range(5):
        drawn = made.sample(count)
        is_prior = firsts(drawn) < 0
        assert len(is_prior) == count
        assert is_prior.sum() == expected
        np.testing.assert_array_equal(drawn.slots == PRIOR_SLOT, is_prior)
        assert set(firsts(drawn)[is_prior]) <= before


def test_without_own_transitions_all_are_prior_and_without_prior_ones_nothing_changes() -> None:
    made, _ = mixed(own=0)
    assert (firsts(made.sample(32)) < 0).all()
    plain, lanes = replay(seed=0), Lanes(1)
    without, _ = mixed(prior=0)
    for _ in range(4):
        plain.add(lanes.used(lanes.rollout(0)))
    for one, other in zip(plain.sample(64), without.sample(64), strict=True):
        np.testing.assert_array_equal(one, other)


def test_every_prior_transition_is_drawn_and_none_is_overwritten() -> None:
    made, before = mixed(own=400)  # the own ones went round the ring
    drawn: set[float] = set()
    for _ in range(40):
        found = firsts(made.sample(100))
        drawn |= set(found[found < 0])
    assert drawn == before


def test_a_prior_row_leads_to_its_own_next_observation() -> None:
    made, _ = mixed()
    drawn = made.sample(200)
    assert ((firsts(drawn) < 0) == (drawn.next_leaves[0][:, 0] < 0)).all()


def test_errors_of_prior_transitions_change_no_priority() -> None:
    made, _ = mixed(alpha=1.0)
    drawn = made.sample(40)
    assert made._priorities is not None
    weights = made._priorities.tree.weights  # a view
    before = weights.copy()
    error = np.where(drawn.slots == PRIOR_SLOT, 1e6, 1.0).astype(np.float32)
    made.update_priorities(drawn.slots, error)
    assert weights.max() < 2
    changed = np.flatnonzero(weights != before)
    assert set(changed) <= set(drawn.slots[drawn.slots != PRIOR_SLOT])


def test_what_is_taken_back_is_drawn_again() -> None:
    made, _ = mixed()
    made.remember()
    first = made.sample(50)
    made.roll_back()
    for one, other in zip(first, made.sample(50), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_restored_replay_draws_on_to_the_bit_and_needs_the_same_dataset() -> None:
    made, _ = mixed()
    made.sample(10)
    file = io.BytesIO()
    torch.save(made.state_dict(), file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    restored, _ = mixed(own=0)
    restored.load_state_dict(state)
    for one, other in zip(made.sample(50), restored.sample(50), strict=True):
        np.testing.assert_array_equal(one, other)
    other_data, _ = mixed(own=0, prior=5)
    with pytest.raises(ValueError, match=r"prior: expected the dataset of the run with \d+ transitions, got \d+"):
        other_data.load_state_dict(state)
    without, _ = mixed(own=0, prior=0)
    with pytest.raises(ValueError, match=r"got 0$"):
        without.load_state_dict(state)


def test_a_dataset_that_does_not_fit_memory_is_refused_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes its own size, once: no checkpoint copies it."""
    made, _ = mixed(prior=0)
    free = replay(10_000).bytes
    monkeypatch.setattr(mixed_replay, "available_bytes", lambda: free)
    made.add_prior([], 10_000, 0.5)
    with pytest.raises(UsageError, match=r"^prior: 10001 observations of the dataset take .* record a smaller dataset$"):
        made.add_prior([], 10_001, 0.5)
