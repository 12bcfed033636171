"""Which rollouts of a client count as lawful. Pure."""

from __future__ import annotations

from millrace.extras.conformance.lane_rows import LaneRows
from millrace.extras.envs.vector_copies import VectorCopies
from millrace.protocol.messages import Weights
from tests.protocol.test_row_law import EndsInResetSteps
from tests.support.in_process.collectors import TOY, VERSION, collect, random_collector, random_weights, run_of


def test_an_end_in_a_step_that_only_resets_is_followed_by_another_reset_and_ends_no_episode() -> None:
    run = run_of(f"{TOY}Countdown-v0", T=5, N=2)
    collector = random_collector(run, lambda run, lane, pulse: VectorCopies(EndsInResetSteps(2)))
    rows, weights = LaneRows(run), Weights(VERSION, *random_weights(run.policy))
    for k in range(3):
        (rollout,) = collect(collector, run, k)
        rows.see(rollout, weights)
    assert rollout.steps_that_reset.T.tolist() == [[True] * 6, [True, False, True, False, True, False]]
