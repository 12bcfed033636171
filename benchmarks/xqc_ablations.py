"""Variants of XQC that each lack one of its parts, to measure what the part contributes.

`python -m benchmarks.xqc_ablations` prints the commands that train them. With `--table FOLDER ...`, it prints the returns of
the runs in these folders. If no setting turns a part off, a separate class does, as in `--algo
benchmarks.xqc_ablations:WithoutTarget`.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from benchmarks.markdown_tables import table
from benchmarks.scores import steps_text
from benchmarks.wall_clock_curves import Curve, found_in, read_curves
from benchmarks.wall_clock_programs import OURS, training
from benchmarks.wall_clock_returns import of_seeds, return_after
from millrace.algorithms import CriticLoss, Transitions
from millrace.learner.algorithms.bodies.actor_with_critics import ActorWithCritics
from millrace.learner.algorithms.bodies.stacked_mlps import MLPShape, Normalized
from millrace.learner.algorithms.xqc import XQC
from millrace.protocol.arrays import Floats

STEPS = 101_000
ENVS = {"HalfCheetah-v5": (20_000, 40_000), "Walker2d-v5": (70_000, 80_000)}
"""the tasks, and the env steps of their columns in the table; on Walker2d-v5, XQC itself has learned little before"""


class WithoutTarget(XQC):
    """The newest critics evaluate the next observations, as in CrossQ."""

    def move_target(self) -> None:
        """Copy the critics to the target critics."""
        self.target.critics.copy_(self.net.critics)


class WithoutJointPass(XQC):
    """Observations and next observations pass through the critics separately, each normalized by its own statistics."""

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """XQC's loss, computed in two passes."""
        joint = self.joint(rows)
        size = len(rows.x)
        with torch.no_grad():
            next_logits = self.target.minibatch_outputs(joint.x[size:], joint.action[size:])
            target = self.target_distribution(rows, next_logits, joint.next_log_prob)
        return self.cross_entropy(rows, self.net.outputs(rows.x, rows.action), target)


class WithoutWeightNorm(XQC):
    """The norms of weights aren't constrained."""

    def shapes(self) -> tuple[MLPShape, MLPShape]:
        """See `XQC`."""
        actor, critics = super().shapes()
        return actor._replace(unit_rows=False, output_gain=0.01), critics._replace(unit_rows=False)


class NormalizedAfter(XQC):
    """Batch normalization after each activation, as in CrossQ."""

    def shapes(self) -> tuple[MLPShape, MLPShape]:
        """See `XQC`."""
        actor, critics = super().shapes()
        return actor._replace(normalized=Normalized.AFTER), critics._replace(normalized=Normalized.AFTER)


class OneValue(XQC):
    """Critics predict one value instead of categories, with a squared loss."""

    def networks(self, device: str) -> ActorWithCritics:
        """See `Continuous`."""
        actor, critics = self.shapes()
        one = critics._replace(sizes=(*critics.sizes[:-1], 1))
        return ActorWithCritics(self.policy, actor, one, lambda outputs: outputs[..., 0], device, self.seed)

    def critic_loss(self, rows: Transitions) -> CriticLoss:
        """½ Σ E[w (Q(s, a) − y)²] over both critics."""
        joint = self.joint(rows)
        size = len(rows.x)
        with torch.no_grad():
            next_values = self.target.minibatch_outputs(joint.x, joint.action)[:, size:, 0].amin(0)
            y = rows.reward + rows.discount * (next_values - self.temperature * joint.next_log_prob)
        values = self.net.outputs(joint.x, joint.action)[:, :size, 0]
        error = values - y
        loss = 0.5 * (rows.weight * error.square()).mean(1).sum()
        return CriticLoss(loss, error.detach().abs().mean(0), {"q_mean": values.mean()})


class ScaledByDeviation(XQC):
    """Rewards are divided by the standard deviation of the discounted return alone, as XQC's authors do."""

    def scaled(self, reward: Floats) -> Floats:
        """See `GradientDescent`."""
        divided: Floats = (reward / self.rewards.std).astype(np.float32)
        return divided


def own(kind: type[XQC]) -> tuple[str]:
    """The name of one of these classes for `--algo`."""
    return (f"benchmarks.xqc_ablations:{kind.__name__}",)


VARIANTS: dict[str, tuple[str, ...]] = {
    "XQC": ("xqc",),
    "critics of 3 × 256": ("xqc", "--critic-net", "256", "256", "256"),
    "critics of 2 × 512": ("xqc", "--critic-net", "512", "512"),
    "two gradient steps an env step": ("xqc", "--updates-per-step", "2"),
    "an actor that learns at every step": ("xqc", "--policy-delay", "1"),
    "no target critics": own(WithoutTarget),
    "two passes in place of one": own(WithoutJointPass),
    "free norms of weights": own(WithoutWeightNorm),
    "normalized after activations": own(NormalizedAfter),
    "one value in place of categories": own(OneValue),
    "rewards by their deviation alone": own(ScaledByDeviation),
}
"""For each variant, its name in `--algo` and further flags"""


def command(env: str, flags: tuple[str, ...], seed: int, folder: str) -> str:
    """The command that trains one variant, in a folder of its own."""
    return shlex.join([*training(env, flags, seed, str(STEPS), folder), "--torch-threads", "1", "--resume", "auto"])


def variant_of(curve: Curve) -> str | None:
    """The variant that a run trained, by the flags of its command: of those that fit, the one with the most flags."""
    words = f"{curve.command} "
    fitting = [
        name
        for name, (algo, *flags) in VARIANTS.items()
        if f" --algo {algo} " in words and (not flags or f" {' '.join(flags)} " in words)
    ]
    return max(fitting, key=lambda name: len(VARIANTS[name]), default=None)


def returns_table(curves: Sequence[Curve]) -> str:
    """The table of the variants' returns on each task, in the order of `VARIANTS`, as Markdown."""
    columns = [(env, steps) for env, several in ENVS.items() for steps in several]
    lines = []
    for name in VARIANTS:
        cells = [of_seeds(returns_of(curves, name, env, steps)) for env, steps in columns]
        if any(cells):
            lines.append((name, *cells))
    return table(("", *(f"{env}, {steps_text(steps)}" for env, steps in columns)), lines)


def returns_of(curves: Iterable[Curve], variant: str, env: str, steps: int) -> list[float]:
    """The returns of all runs of a variant in the first evaluation after this number of env steps."""
    mine = (curve for curve in curves if curve.env == env and variant_of(curve) == variant)
    return [returned for curve in mine if (returned := return_after(curve, steps)) is not None]


def main() -> None:
    parser = argparse.ArgumentParser(description="print the commands that train XQC without one of its parts each")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--out", default="runs/ablations")
    parser.add_argument("--table", type=Path, nargs="+", metavar="FOLDER", help="print the returns of these runs")
    given = parser.parse_args()
    if given.table:
        kept = [curve for curve in read_curves() if (curve.system, curve.algo) == (OURS, "xqc")]
        print(returns_table([*kept, *chain.from_iterable(found_in(folder, None) for folder in given.table)]))
        return
    for seed in given.seeds:
        for number, flags in enumerate(VARIANTS.values()):
            for env in ENVS:
                print(command(env, flags, seed, f"{given.out}/{number}"))


if __name__ == "__main__":
    main()
