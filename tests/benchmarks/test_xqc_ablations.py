"""The table of XQC's variants: each run is counted to the variant that it trained."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.wall_clock_curves import Curve
from benchmarks.xqc_ablations import VARIANTS, ScaledByDeviation, command, returns_table, variant_of
from tests.learner.algorithms.test_continuous import made

ENV = "HalfCheetah-v5"


def curve(words: str, *points: tuple[int, float]) -> Curve:
    return Curve(env=ENV, system="millrace", algo="any", seed=1, command=words, processor="p", points=[*points])


@pytest.mark.parametrize("name", VARIANTS)
def test_a_run_belongs_to_the_variant_whose_command_trained_it(name: str) -> None:
    assert variant_of(curve(command(ENV, VARIANTS[name], 1, "runs"))) == name


def test_a_run_of_another_algorithm_is_of_no_variant() -> None:
    assert variant_of(curve(command(ENV, ("sac",), 1, "runs"))) is None


def test_the_table_has_a_line_for_each_variant_that_was_trained() -> None:
    whole = curve("millrace train --algo xqc", (20_000, 100.0), (40_000, 300.0))
    other = curve("millrace train --algo xqc --policy-delay 1", (20_000, 200.0))
    assert returns_table([other, whole, whole]).splitlines()[2:] == [
        "| XQC | 100 (100 to 100, 2 seeds) | 300 (300 to 300, 2 seeds) |  |  |",
        "| an actor that learns at every step | 200 (one seed) |  |  |  |",
    ]


def test_rewards_by_their_deviation_alone_have_no_bound() -> None:
    bounded = made("xqc", return_bound=5)
    free = ScaledByDeviation(bounded.config, bounded.policy, total_steps=10_000, seed=0)
    rewards = np.ones(1, np.float32)
    for algorithm in (bounded, free):
        algorithm.rewards.may_last(rewards, np.full(1, 0.99))  # its value, 100, exceeds the bound of 5
    assert [float(each.scaled(rewards)[0]) for each in (bounded, free)] == pytest.approx([0.05, 1])
