"""Whole runs that learn from a dataset too: for any number of workers, after a resume, and with data that does not fit."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from torch import Tensor

from millrace import Callback, Progress
from millrace.cli.main import main
from millrace.extras.datasets import cloning
from millrace.extras.datasets.demonstrations import Demonstrations
from millrace.extras.datasets.prior_dataset import PriorDataset
from millrace.launch.training import train
from millrace.learner.algorithms.dqn import DQN
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.callbacks.callbacks import Callbacks
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.run_folder import Interrupted
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from tests.system.stage.run_folders import policy_of

minari = pytest.importorskip("minari")
DATASET = "cartpole/random-v0"
SMALL: dict[str, Any] = {
    "algo": "dqn",
    "preset": "none",
    "transport": "inproc",
    "seed": 3,
    "rollout_steps": 16,
    "learning_starts": 300,
    "gradient_steps": 16,
    "eval_episodes": 1,
    "steps": 1_000,
    "prior": DATASET,
}
CLONED: dict[str, Any] = {
    "algo": "ppo",
    "preset": "none",
    "transport": "inproc",
    "seed": 3,
    "rollout_steps": 32,
    "n_epochs": 2,
    "eval_episodes": 1,
    "steps": 512,
    "prior": DATASET,
    "clone_epochs": 3,
}


def write(dataset_id: str, env_id: str, episodes: int) -> None:
    """A dataset of random episodes."""
    from minari.data_collector import EpisodeBuffer

    env, generator = gymnasium.make(env_id), np.random.default_rng(1)
    buffers = []
    for number in range(episodes):
        seen, _ = env.reset(seed=number)
        rows: list[Any] = [seen]
        actions: list[int] = []
        rewards: list[float] = []
        ends: list[tuple[bool, bool]] = []
        while not ends or not any(ends[-1]):
            actions.append(int(generator.integers(env.action_space.n)))  # type: ignore[attr-defined]
            seen, reward, terminated, truncated, _ = env.step(actions[-1])
            rows.append(seen)
            rewards.append(float(reward))
            ends.append((terminated, truncated))
        terminations, truncations = np.array(ends).T
        buffers.append(
            EpisodeBuffer(
                id=number,
                observations=np.array(rows),
                actions=np.array(actions),
                rewards=rewards,
                terminations=terminations,
                truncations=truncations,
                infos={},
            )
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
        minari.create_dataset_from_buffers(dataset_id, buffer=buffers, data_format="hdf5", **spaces)
    env.close()


@pytest.fixture(autouse=True)
def dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    write(DATASET, "CartPole-v1", episodes=20)


def run(tmp_path: Path, name: str, resume: Path | None = None, base: dict[str, Any] = SMALL, **settings: Any) -> Path:
    keywords = base | settings
    config = resolve("" if resume else "CartPole-v1", run_dir=str(tmp_path / name), resume=resume, **keywords)
    return train(config, resume, lambda _: None)


def test_prior_data_changes_what_is_learned_and_the_number_of_workers_does_not(tmp_path: Path) -> None:
    one, two = (policy_of(run(tmp_path, f"{workers}", workers=workers, prior_steps=50)) for workers in (1, 2))
    assert one == two
    assert policy_of(run(tmp_path, "none", workers=1, prior="")) != one
    less = policy_of(run(tmp_path, "less", workers=1, prior_steps=50, prior_share=0.25))
    assert less != one


def test_gradient_steps_before_the_first_rollouts_are_those_that_were_asked_for(tmp_path: Path) -> None:
    folder = run(tmp_path, "steps", workers=1, prior_steps=50)
    first = read_rows(folder / "metrics.jsonl")[0]
    assert first["train/n_updates"] == 50, "no gradient step on own rows before learning_starts"
    without = run(tmp_path, "without", workers=1)
    assert read_rows(without / "metrics.jsonl")[0]["train/n_updates"] == 0


def test_a_resumed_run_keeps_its_dataset_and_refuses_another(tmp_path: Path) -> None:
    folder = run(tmp_path, "first", workers=1, steps=800, prior_steps=10)
    resumed = run(tmp_path, "first", resume=folder, workers=1, steps=1_500)
    assert read_rows(resumed / "metrics.jsonl")[-1]["train/n_updates"] > 10
    with pytest.raises(UsageError, match=r"prior: expected cartpole/random-v0 as in its config.toml, got ;"):
        run(tmp_path, "first", resume=folder, workers=1, steps=2_000, prior="", prior_steps=0)


def test_gradient_steps_before_the_first_rollouts_can_be_interrupted_and_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings: dict[str, Any] = {"workers": 1, "prior_steps": 50}
    whole = run(tmp_path, "whole", **settings)
    step = DQN.step

    def interrupted_step(self: DQN, rows: Transitions) -> tuple[dict[str, float], Tensor]:
        if self.gradient_steps == 20:
            signal.raise_signal(signal.SIGTERM)
        return step(self, rows)

    with monkeypatch.context() as patched, pytest.raises(Interrupted) as stopped:
        patched.setattr(DQN, "step", interrupted_step)
        run(tmp_path, "stopped", **settings)
    resumed = run(tmp_path, "stopped", resume=stopped.value.run, **settings)
    assert policy_of(resumed) == policy_of(whole)


def test_a_clone_does_not_depend_on_the_number_of_workers_and_a_resumed_run_does_not_clone_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = (run(tmp_path, f"{workers}", base=CLONED, workers=workers) for workers in (1, 2))
    assert policy_of(one) == policy_of(two)
    assert policy_of(one) != policy_of(run(tmp_path, "none", base=CLONED, prior="", clone_epochs=0))
    first, second, *_ = read_rows(one / "metrics.jsonl")
    assert (first["time/iterations"], second["time/iterations"]) == (0, 1)
    assert 0.4 < first["clone/accuracy"] < 0.7, "the actions are random"
    monkeypatch.setattr(cloning, "cloning_loss", None)
    run(tmp_path, "1", resume=one, base=CLONED, steps=1_024)


def test_cloning_that_was_interrupted_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run(tmp_path, "whole", base=CLONED)
    loss = cloning.cloning_loss

    def interrupted_loss(algorithm: PPO, rows: Demonstrations) -> tuple[Tensor, Tensor]:
        if algorithm.pretraining_steps == 10:
            signal.raise_signal(signal.SIGTERM)
        return loss(algorithm, rows)

    with monkeypatch.context() as patched, pytest.raises(Interrupted) as stopped:
        patched.setattr(cloning, "cloning_loss", interrupted_loss)
        run(tmp_path, "stopped", base=CLONED)
    resumed = run(tmp_path, "stopped", resume=stopped.value.run, base=CLONED)
    assert policy_of(resumed) == policy_of(whole)


@pytest.mark.parametrize("eval_workers", [0, 1])
def test_a_cloned_policy_is_evaluated_once_even_if_the_run_is_interrupted_then(tmp_path: Path, eval_workers: int) -> None:
    class Evaluations(Callback):
        def __init__(self, interrupts: str) -> None:
            self.of_versions: list[int] = []
            self._interrupts = interrupts

        def on_evaluation(self, progress: Progress) -> None:
            self.of_versions.append(progress.evaluated.version)
            self._interrupt("on_evaluation")

        def on_rollouts(self, progress: Progress) -> None:
            self._interrupt("on_rollouts")

        def _interrupt(self, moment: str) -> None:
            if moment == self._interrupts:
                raise KeyboardInterrupt

    def evaluated(name: str, resume: Path | None = None, interrupts: str = "") -> list[int]:
        told = Evaluations(interrupts)
        config = resolve(
            "" if resume else "CartPole-v1", run_dir=str(tmp_path / name), resume=resume,
            **(CLONED | {"workers": 2, "eval_every": 200, "eval_workers": eval_workers}),
        )  # fmt: skip
        with pytest.raises(KeyboardInterrupt) if interrupts else nullcontext():
            train(config, resume, Callbacks([told]))
        return told.of_versions

    whole = evaluated("whole")
    before = evaluated("stopped", interrupts="on_rollouts" if eval_workers else "on_evaluation")
    (stopped,) = (tmp_path / "stopped").iterdir()
    assert before == ([] if eval_workers else [0])
    assert before + evaluated("stopped", resume=stopped) == whole


def test_an_interrupt_while_the_dataset_is_read_leaves_no_run_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = PriorDataset.batches

    def interrupted_batches(self: PriorDataset) -> Iterator[Batch]:
        signal.raise_signal(signal.SIGTERM)
        return batches(self)

    monkeypatch.setattr(PriorDataset, "batches", interrupted_batches)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, "stopped", workers=1)
    assert not (tmp_path / "stopped").exists()


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--prior", "acrobot/random-v0"], "prior acrobot/random-v0: observations: expected "),
        (["--prior", "cartpole/rondom-v0"], "no such dataset here; there are: acrobot/random-v0, cartpole/random-v0"),
        (["--algo", "ppo", "--prior", DATASET], "prior cartpole/random-v0: ppo can only clone it; add --clone-epochs "),
        (["--algo", "ppo", "--clone-epochs", "5"], "clone_epochs: expected 0 without prior data, got 5; name it by --prior"),
        (
            ["--algo", "ppo", "--prior", DATASET, "--clone-epochs", "5", "--core", "gru"],
            "clone_epochs: expected 0 with a recurrent core, got 5; take --core none",
        ),
        (
            ["--algo", "a2c", "--prior", "acrobot/random-v0", "--clone-epochs", "5"],
            "prior acrobot/random-v0: observations: expected ",
        ),
        (["--prior-steps", "5"], "prior_steps: expected 0 without prior data, got 5; name it by --prior"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line_and_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], says: str
) -> None:
    write("acrobot/random-v0", "Acrobot-v1", episodes=1)
    algo = [] if "--algo" in flags else ["--algo", "dqn"]
    command = ["train", "CartPole-v1", *algo, *flags, "--workers", "1", "--run-dir", str(tmp_path / "runs")]
    assert main(command) == 2
    _, err = capsys.readouterr()
    assert says in err
    assert err.count("\n") == 1
    assert not list((tmp_path / "runs").glob("*"))
