"""What the timed updates are: `graph` passes in torch, `ours` as in a run."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.arithmetic import flop_per_s, products_ms
from benchmarks.contest import Contest
from benchmarks.update_ppo import contest
from millrace.learner.algorithms.kernels.mlp import SmallMLP


def contests() -> list[Contest]:
    pytest.importorskip("stable_baselines3")
    from benchmarks import update_stable_baselines3 as peer

    return [peer.dqn(8, 1), peer.a2c(5, 1), peer.continuous("SAC", 8, None), peer.continuous("TD3", 8, None)]


def test_ours_passes_in_numpy_and_graph_in_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    passes: list[SmallMLP] = []
    call = SmallMLP.__call__

    def counted(self: SmallMLP, *args: Any, **keywords: Any) -> Any:
        passes.append(self)
        return call(self, *args, **keywords)

    monkeypatch.setattr(SmallMLP, "__call__", counted)
    for made in [contest(64, None, width=8), *contests()]:
        for name in ("graph", "ours"):
            passes.clear()
            made.runs[name]()
            assert (len(passes) > 0) == (name == "ours"), made.title


def test_the_products_of_an_update_are_counted() -> None:
    """Forward, weights and inputs of three layers of an actor and a critic; features have no gradient."""
    rows, units = 64, 8
    made = contest(rows, None, width=units)
    forward = [(4, units), (units, units), (units, 2), (4, units), (units, units), (units, 1)]
    products = sum(3 * inputs * outputs for inputs, outputs in forward) - 2 * 4 * units
    assert products_ms(made.runs["graph"], made.repeats) == pytest.approx(2 * rows * products / flop_per_s() * 1e3)
