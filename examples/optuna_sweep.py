"""A sweep with optuna: each trial trains several seeds, and is pruned after an evaluation if other trials were better.

    pip install optuna
    python examples/optuna_sweep.py

It runs 20 trials of 3 seeds with 50,000 env steps each. That is at most 3 million env steps, some of which pruning saves,
and takes between ten minutes and half an hour on two cores. Each trial prints a line when it ends. For a quick test, call
`sweep(2, steps=5_000)`.

A trial's value is the mean return over its seeds. The seeds run one after another; at each evaluation, optuna sees the mean
over the seeds so far. A pruned run ends as if its steps were done, so its workers leave and its folder is complete.

The best trial's value is the highest of many, so it is biased upwards. The program's last line therefore trains with that
trial's settings and other seeds, and prints the returns that they reach.
"""

from __future__ import annotations

from statistics import fmean
from typing import Any

import optuna

import millrace

SEEDS, OTHER_SEEDS = (1, 2, 3), (11, 12, 13)
ENV, STEPS = "CartPole-v1", 50_000


class Prune(millrace.Callback):
    """Reports one seed's evaluations to optuna, and ends the run if optuna prunes the trial."""

    def __init__(self, trial: optuna.Trial, finished: list[float], most_steps: int) -> None:
        """`finished`: the returns of the previous seeds. `most_steps`: a number larger than one seed's env steps."""
        self.trial, self.finished, self.first_step = trial, finished, len(finished) * most_steps
        self.pruned = False

    def on_evaluation(self, progress: millrace.Progress) -> bool:
        """Report the mean over the seeds so far. Returns False to end the run."""
        assert progress.evaluation is not None
        self.trial.report(fmean([*self.finished, progress.evaluation.return_mean]), self.first_step + progress.env_steps)
        self.pruned = self.pruned or self.trial.should_prune()
        return not self.pruned


def final_return(run: millrace.Run) -> float:
    """The mean return of the evaluation at the end of a run."""
    assert run.summary is not None
    assert run.summary.evaluation is not None
    return run.summary.evaluation.return_mean


def objective(trial: optuna.Trial, env: str = ENV, **settings: Any) -> float:
    """Train all seeds with this trial's settings."""
    chosen = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True),
        "gamma": trial.suggest_categorical("gamma", [0.98, 0.99]),
    }
    steps = settings.pop("steps", STEPS)
    returns: list[float] = []
    for seed in SEEDS:
        prune = Prune(trial, returns, 2 * steps)
        keywords = {"eval_every": steps // 5, "eval_episodes": 20, "progress": False, **settings, **chosen}
        run = millrace.train(env, seed=seed, steps=steps, callbacks=[prune], **keywords)
        if prune.pruned:
            raise optuna.TrialPruned
        returns.append(final_return(run))
    return fmean(returns)


def sweep(trials: int, **settings: Any) -> optuna.Study:
    """Run the trials. `settings`: keywords for `millrace.train` that all trials share."""
    study = optuna.create_study(
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=1),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=2),
    )
    study.optimize(lambda trial: objective(trial, **settings), n_trials=trials)
    return study


if __name__ == "__main__":
    best = sweep(20).best_trial
    print(f"chosen by a mean return of {best.value:.1f}: {best.params}")
    runs = [millrace.train(ENV, seed=seed, steps=STEPS, progress=False, **best.params) for seed in OTHER_SEEDS]
    print(f"measured with other seeds: {fmean(map(final_return, runs)):.1f}")
