"""A run that is interrupted and resumed equals, bit for bit, one that went on and whose lanes were started anew meanwhile.

For every algorithm, with its replay buffer, and with the best policy of its evaluations. And the interruption takes no
longer than the grace time.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import millrace.learner.interrupts
from millrace.launch.training import train
from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithms import Algorithm, algorithm_class
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.between_updates import evaluations
from millrace.learner.callbacks.callbacks import Callbacks, Watch
from millrace.learner.config.layers import resolve
from millrace.learner.interrupts import Interrupts
from millrace.learner.rollouts.evaluation_dealer import PlayedEpisode, evaluation_of
from millrace.learner.rollouts.hub import Hub
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import Evaluation
from millrace.learner.run_folder.run_folder import Interrupted
from millrace.protocol.rollout import Batch
from tests.support.conversation.rules import pending_evaluation
from tests.system.stage.processes import START_S, Stage, crowding
from tests.system.stage.run_folders import folder_of, policy_of, saved_rollouts, summary

ENV = "tests.system.ends_and_resume.restarting_env:Restarting-v0"
T, LANES, ENVS = 16, 2, 4
COMMON: dict[str, Any] = {
    "preset": "none", "lanes": LANES, "envs": ENVS, "rollout_steps": T, "net": (8,), "steps": 12 * T * ENVS, "seed": 3,
    "transport": "inproc", "workers": 1, "eval_every": 100, "eval_episodes": 4, "eval_copies": 4, "eval_max_steps": 120,
    "max_lag": 0, "checkpoint_every_s": 1000.0,
}  # fmt: skip
NORMAL = {"normalize_observations": True, "normalize_rewards": True}
PPO_SETTINGS = {"algo": "ppo", "n_epochs": 2, "batch_size": 16}
DQN = {"algo": "dqn", "learning_starts": 100, "gradient_steps": 4, "batch_size": 16, "replay_size": 300}
PUSHES = {
    "wrappers": ("tests.system.ends_and_resume.restarting_env:Push",), "learning_starts": 100, "updates_per_step": 0.1,
    "batch_size": 16, "replay_size": 300,
}  # fmt: skip
VARIANTS: dict[str, dict[str, Any]] = {
    "ppo": {**PPO_SETTINGS, **NORMAL, "learning_rate_schedule": "linear", "clip_range_schedule": "linear"},
    "ppo, lstm": {**PPO_SETTINGS, "core": "lstm", "core_size": 4, "normalize_rewards": True},
    "ppo, mixed actions": {**PPO_SETTINGS, "wrappers": ("tests.system.ends_and_resume.restarting_env:Both",)},
    "a2c": {"algo": "a2c", **NORMAL},
    "impala": {"algo": "impala", **NORMAL},
    "reinforce": {"algo": "reinforce", **NORMAL, "rollout_steps": 31, "steps": 12 * 31 * ENVS, "eval_every": 200},
    "dqn, uniform": {**DQN, "normalize_observations": True},
    "dqn, prioritized": {**DQN, "priority_alpha": 0.6, "n_step": 3, "amsgrad": True, "dueling": True},
    "dqn, gru": {**DQN, "core": "gru", "core_size": 4, "priority_alpha": 0.6},
    "sac, lstm": {**PUSHES, "algo": "sac", "core": "lstm", "core_size": 4},
    "rainbow": {**DQN, "algo": "rainbow", "quantiles": 5, "normalize_observations": True},
    "tqc": {**PUSHES, "algo": "tqc", "quantiles": 5},
    "crossq": {**PUSHES, "algo": "crossq", "critic_net": (8,), "renormalize_after": 40},
    "xqc": {**PUSHES, "algo": "xqc", "critic_net": (8,), "atoms": 21, "priority_alpha": 0.6, "normalize_observations": True},
    "sac, hindsight": {
        "env": "tests.support.envs.reach:Reach-v0",
        "env_kwargs": {"limit": 9, "within": 0.5, "ends": True},
        "algo": "sac",
        "learning_starts": 100,
        "updates_per_step": 0.1,
        "batch_size": 16,
        "replay_size": 300,
        "n_step": 3,
        "hindsight": 0.8,
        "goal_reward": "sparse:0.5",
        "goal_ends": 0.5,
    },
    "ppo, evaluated beside": {**PPO_SETTINGS, **NORMAL, "eval_workers": 1, "learning_rate": 0.02},
}
IN_MAKE_TEST = (
    "ppo",
    "ppo, lstm",
    "dqn, prioritized",
    "dqn, gru",
    "rainbow",
    "xqc",
    "sac, hindsight",
    "ppo, evaluated beside",
)  # `make soak` runs the others
STOP = 6  # the update after which a run is interrupted


def silent(progress: Progress) -> None:
    """Show nothing."""


def run(tmp_path: Path, watch: Watch = silent, resume: Path | None = None, **settings: Any) -> Path:
    keywords = {"env": ENV, **COMMON, **settings}
    return train(resolve(keywords.pop("env"), run_dir=str(tmp_path), **keywords), resume, watch)


def restarted(tmp_path: Path, after: int, **settings: Any) -> Path:
    """A run that goes on, and whose lanes are all started anew while they collect under the version `after`."""
    rows = settings.get("rollout_steps", T)
    kwargs = {"at": after * rows + rows // 2, "once": str(tmp_path / "failed")}
    folder = run(tmp_path / "restarted", env_kwargs=kwargs, **settings)
    assert (tmp_path / "failed").exists(), "no lane was started anew"
    assert summary(folder)["ledger"]["lost"] == LANES, "the lanes were not started anew together"
    return folder


def interrupts_at(update: int) -> Watch:
    def watch(progress: Progress) -> None:
        if progress.updates == update and not progress.waiting.startswith("evaluating"):
            raise KeyboardInterrupt

    return watch


MAY_DIFFER = {"wall_s", "stages"}
"""The times in a checkpoint. Tickets and lanes that were lost with the old learner or worker also make a difference."""


def assert_equal(one: Path, other: Path) -> None:
    """All that docs/how-to/resume.md says is equal is equal."""
    (a, _), (b, _) = checkpoint.newest(one), checkpoint.newest(other)
    assert a.env_steps == b.env_steps
    for part in ("algorithm", "best_policy"):
        assert first_difference(a.state[part], b.state[part]) is None, part
    past, other_past = a.state["past"], b.state["past"]
    assert past.keys() == other_past.keys()
    for of_one in (past, other_past):
        of_one["episodes"] = [(reward, length) for reward, length, *_ in of_one["episodes"]]  # without their seconds
    for name in past.keys() - MAY_DIFFER:
        assert past[name] == other_past[name], name
    assert saved_rollouts(one).rounds == saved_rollouts(other).rounds
    for file in ("policy.safetensors", "best.safetensors"):
        assert (one / file).read_bytes() == (other / file).read_bytes(), file
    for name in ("env_steps", "updates", "stop_reason", "return_mean_100", "evaluation", "best"):
        assert summary(one)[name] == summary(other)[name], name
    rows, others = read_rows(one / "metrics.jsonl"), read_rows(other / "metrics.jsonl")
    assert [numbers(row) for row in rows] == [numbers(row) for row in others]


def numbers(row: dict[str, Any]) -> dict[str, Any]:
    """The numbers of a row of metrics that do not depend on time and on lost tickets."""
    kept = {name: row[name] for name in row if name.startswith(("train/", "rollout/", "eval/", "replay/", "lag/"))}
    return kept | {name: row[name] for name in ("time/iterations", "time/total_timesteps", "ledger/used")}


@pytest.mark.parametrize(
    "variant", [name if name in IN_MAKE_TEST else pytest.param(name, marks=pytest.mark.soak) for name in VARIANTS]
)
def test_a_resumed_run_equals_one_that_went_on(tmp_path: Path, variant: str) -> None:
    settings = VARIANTS[variant]
    reference = run(tmp_path / "whole", **settings)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "resumed", interrupts_at(STOP), **settings)
    folder = folder_of(tmp_path / "resumed")
    assert checkpoint.newest(folder)[0].state["past"]["state"]["version"] == STOP
    assert run(tmp_path / "resumed", resume=folder, **settings) == folder
    assert_equal(reference, folder)


def test_a_resumed_run_whose_copies_are_made_anew_equals_one_whose_copies_stay(tmp_path: Path) -> None:
    settings = VARIANTS["ppo"]
    reference = run(tmp_path / "whole", **settings)
    anew = {**settings, "restart_episodes": 1, "workers": 2}
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "resumed", interrupts_at(STOP), **anew)
    folder = run(tmp_path / "resumed", resume=folder_of(tmp_path / "resumed"), **anew)
    assert_equal(reference, folder)


def test_with_restart_a_resumed_run_equals_one_whose_lanes_were_started_anew(tmp_path: Path) -> None:
    settings = {**VARIANTS["ppo"], "lost_lanes": "restart"}
    reference = restarted(tmp_path, STOP, **settings)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "resumed", interrupts_at(STOP), **settings)
    folder = run(tmp_path / "resumed", resume=folder_of(tmp_path / "resumed"), **settings)
    assert_equal(reference, folder)
    plain = run(tmp_path / "plain", **settings)
    assert policy_of(plain) != policy_of(folder), "starting lanes anew changes nothing, so this shows nothing"


def test_a_run_that_is_resumed_without_evaluators_evaluates_first_what_was_beside_training(tmp_path: Path) -> None:
    settings = {**VARIANTS["ppo, evaluated beside"], "lost_lanes": "restart", "seed": 9}
    reference = restarted(tmp_path, STOP, **{**settings, "eval_workers": 0})
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "resumed", interrupts_at(STOP), **settings)
    folder = folder_of(tmp_path / "resumed")
    pending = checkpoint.newest(folder)[0].state["past"]["state"]["pending"]
    assert 0 < pending["version"] < STOP, "it was interrupted when no evaluation was beside training"
    run(tmp_path / "resumed", resume=folder, **{**settings, "eval_workers": 0})
    assert evaluated(folder) == evaluated(reference)
    assert len({mean for _, mean in evaluated(folder)}) > 3, "policies cannot be told from each other by their returns"
    for file in ("policy.safetensors", "best.safetensors"):
        assert (folder / file).read_bytes() == (reference / file).read_bytes(), file


def test_an_evaluation_that_training_waited_for_has_a_row_after_a_resume_without_evaluators(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the evaluation begins again, the next one is due after the same update."""
    settings = VARIANTS["ppo, evaluated beside"]
    reference = run(tmp_path / "whole", **{**settings, "eval_workers": 0})
    end_evaluation = Hub.end_evaluation
    awaited: list[Hub] = []

    def interrupted(hub: Hub, watch: Callable[[int, int], None]) -> list[PlayedEpisode]:
        awaited.append(hub)
        if len(awaited) == 3:
            raise KeyboardInterrupt
        return end_evaluation(hub, watch)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Hub, "end_evaluation", interrupted)
        run(tmp_path / "resumed", **settings)
    folder = folder_of(tmp_path / "resumed")
    run(tmp_path / "resumed", resume=folder, **{**settings, "eval_workers": 0})
    assert evaluated(folder) == evaluated(reference)


class Ends:
    """A callback that ends the run in a method, once it has been told of two evaluations."""

    def __init__(self, method: str) -> None:
        self.told: list[tuple[float, float]] = []
        self._method = method

    def on_evaluation(self, progress: Progress) -> bool:
        assert progress.evaluation is not None
        self.told.append((progress.evaluated.env_steps, progress.evaluation.return_mean))
        return self._goes_on("on_evaluation")

    def on_rollouts(self, progress: Progress) -> bool:
        return self._goes_on("on_rollouts")

    def _goes_on(self, method: str) -> bool:
        return method != self._method or len(self.told) < 2


@pytest.mark.parametrize("method", ["on_evaluation", "on_rollouts"])
def test_a_run_that_a_callback_ends_has_all_results_of_which_it_was_told(tmp_path: Path, method: str) -> None:
    ends = Ends(method)
    folder = run(tmp_path, Callbacks([ends]), **VARIANTS["ppo, evaluated beside"])
    final = [(summary(folder)["env_steps"], summary(folder)["evaluation"]["return_mean"])]
    assert len(ends.told) == 3, "two, and at the end one more"
    assert ends.told == evaluated(folder) + (final if method == "on_evaluation" else [])
    assert summary(folder)["stop_reason"] == f"ended by Ends.{method}"
    assert summary(folder)["ended_by"] is None, "no evaluation of the final policy ended it"


def evaluated(folder: Path) -> list[tuple[float, float]]:
    """Env steps and mean return of each evaluated policy."""
    rows = [row for row in read_rows(folder / "metrics.jsonl") if "eval/mean_reward" in row]
    return [(row.get("eval/env_steps", row["time/total_timesteps"]), row["eval/mean_reward"]) for row in rows]


@pytest.mark.parametrize("variant", ["impala", "xqc"])
def test_at_a_lag_a_resumed_run_equals_one_that_went_on(tmp_path: Path, variant: str) -> None:
    """Its first updates after the checkpoint use weights that are older than those of the checkpoint."""
    settings = {**VARIANTS[variant], "max_lag": 2}
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "one", interrupts_at(STOP), **settings)
    folder = folder_of(tmp_path / "one")
    run(tmp_path / "one", resume=folder, **{**settings, "workers": 2})
    assert_equal(run(tmp_path / "whole", **settings), folder)


@pytest.mark.parametrize("max_lag", [0, 1])
@pytest.mark.parametrize("variant", ["ppo, lstm", "dqn, prioritized"])
def test_a_run_that_is_resumed_after_an_update_was_undone_equals_one_that_went_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str, max_lag: int
) -> None:
    """It is interrupted at the end of the fourth update. The newest checkpoint is that of the second."""
    settings = {**VARIANTS[variant], "max_lag": max_lag}
    reference = run(tmp_path / "whole", **settings)
    kind = algorithm_class(settings["algo"])
    update, updates = kind.update, list[object]()

    def interrupted(self: Algorithm, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        metrics = update(self, batch, pulse)
        updates.append(batch)
        if len(updates) == 4:
            raise KeyboardInterrupt
        return metrics

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(kind, "update", interrupted)
        run(tmp_path / "resumed", **settings)
    folder = folder_of(tmp_path / "resumed")
    assert checkpoint.newest(folder)[0].state["past"]["state"]["version"] == 3
    run(tmp_path / "resumed", resume=folder, **settings)
    assert_equal(reference, folder)


def test_the_best_policy_is_that_of_the_checkpoint(tmp_path: Path) -> None:
    """A run goes on from an older checkpoint than the newest. The policy that was the best later is not its best."""
    settings = {**VARIANTS["ppo"], "lost_lanes": "restart", "learning_rate": 0.05}
    settings |= {"checkpoint_every_s": 0.0, "keep_checkpoints": 100}
    folder = run(tmp_path / "resumed", **settings)
    later = summary(folder)["best"]
    saved = {path: checkpoint.load(path) for path in (folder / "checkpoints").iterdir()}
    versions = {path: found.state["past"]["state"]["version"] for path, found in saved.items()}
    stop = next(versions[path] for path, found in saved.items() if found.env_steps == later["env_steps"]) - 1
    assert stop > 1, "the best policy of the first run is its first, so this shows nothing"
    reference = restarted(tmp_path, stop, **settings)
    for path, version in versions.items():
        if version > stop:
            path.unlink()
    (folder / "summary.json").unlink()
    assert run(tmp_path / "resumed", resume=folder, **settings) == folder
    assert summary(folder)["best"] != later, "the second part of the run is that of the first, so this shows nothing"
    assert_equal(reference, folder)


def test_a_run_that_has_reached_its_return_does_not_train_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {**VARIANTS["ppo"], "target_return": 1.0}
    whole = run(tmp_path / "whole", **settings)
    assert summary(whole)["stop_reason"] == "target return 1 reached"
    folder = interrupted_at_the_end(tmp_path / "resumed", monkeypatch, **settings)
    assert run(tmp_path / "resumed", resume=folder, **settings) == folder
    assert_equal(whole, folder)


@pytest.mark.parametrize(
    ("variant", "settings", "returns", "reason"),
    [
        ("ppo, evaluated beside", {}, [6.0, 1.0, 5.5], "target return 5 reached by the policy of 124 env steps"),
        ("ppo", {"eval_every": 500}, [1.0, 6.0, 5.5], "all steps done"),
    ],
)
def test_the_evaluation_of_the_final_policy_does_not_change_why_a_run_ended(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    variant: str,
    settings: dict[str, Any],
    returns: list[float],
    reason: str,
) -> None:
    """The final policy misses the target that an earlier one reached, or the other way round."""
    settings = {**VARIANTS[variant], **settings, "target_return": 5.0}
    script: list[float] = []

    def scripted(*played: Any) -> Evaluation:
        return msgspec.structs.replace(evaluation_of(*played), return_mean=script.pop(0))

    monkeypatch.setattr(evaluations, "evaluation_of", scripted)
    script[:] = returns
    whole = run(tmp_path / "whole", **settings)
    assert (summary(whole)["stop_reason"], script) == (reason, [])
    written = (whole / "summary.json").stat().st_mtime_ns
    assert run(tmp_path / "whole", resume=whole, **settings) == whole
    assert (whole / "summary.json").stat().st_mtime_ns == written, "the finished run was opened again"
    script[:] = returns
    folder = interrupted_at_the_end(tmp_path / "resumed", monkeypatch, **settings)
    script[:] = returns[-1:]
    assert run(tmp_path / "resumed", resume=folder, **settings) == folder
    assert_equal(whole, folder)


def interrupted_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> Path:
    """A run that is interrupted while its best policy is evaluated again, after its last checkpoint. Returns its folder."""
    end_evaluation = Hub.end_evaluation

    def interrupted(hub: Hub, watch: Callable[[int, int], None]) -> list[PlayedEpisode]:
        of_best = pending_evaluation(hub.coordinator).plan.of_best
        played = end_evaluation(hub, watch)
        if of_best:
            raise KeyboardInterrupt
        return played

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Hub, "end_evaluation", interrupted)
        run(tmp_path, **settings)
    return folder_of(tmp_path)


# ---------------------------------------------------------------- the grace time


def interrupted_in_an_update(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, minibatch_s: float, **settings: Any
) -> tuple[Path, float]:
    """A run that gets SIGTERM in the fourth update, whose minibatches take so long, by its clock.

    Returns its folder, and the seconds from the signal to the end, by the same clock.
    """
    differentiate, clock = PPO.differentiate, [1000.0]
    monkeypatch.setattr(millrace.learner.interrupts, "monotonic", lambda: clock[0])
    began: list[float] = []

    def slow(self: PPO, *given: Any) -> dict[str, float]:
        if self.version == 3:
            if not began:
                began.append(clock[0])
                signal.raise_signal(signal.SIGTERM)
            clock[0] += minibatch_s
        return differentiate(self, *given)

    monkeypatch.setattr(PPO, "differentiate", slow)
    with pytest.raises(Interrupted):
        run(tmp_path / "runs", **VARIANTS["ppo"], **settings)
    monkeypatch.undo()
    return folder_of(tmp_path / "runs"), clock[0] - began[0]


def test_an_update_that_fits_into_the_grace_time_is_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, seconds = interrupted_in_an_update(tmp_path, monkeypatch, 1.0, grace_s=30.0)
    assert checkpoint.newest(folder)[0].state["past"]["state"]["version"] == 4
    assert seconds == 8, "eight minibatches"
    assert summary(folder)["stop_reason"] == "interrupted"


def test_an_update_that_does_not_fit_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "whole", interrupts_at(3), **VARIANTS["ppo"])
    folder, seconds = interrupted_in_an_update(tmp_path, monkeypatch, 4.0, grace_s=30.0)
    assert 15 <= seconds <= 20, "it is given up when half of the grace time is over"
    (whole, _), (broken, _) = (checkpoint.newest(one) for one in (folder_of(tmp_path / "whole"), folder))
    assert first_difference(whole.state["algorithm"], broken.state["algorithm"]) is None
    assert broken.state["past"]["state"]["version"] == 3
    assert summary(folder)["ledger"]["outstanding"] == LANES, "the rollouts of the update that was taken back"


def test_without_a_grace_time_an_update_takes_what_it_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, _ = interrupted_in_an_update(tmp_path, monkeypatch, 1e4, grace_s=0.0)
    assert checkpoint.newest(folder)[0].state["past"]["state"]["version"] == 4


def test_time_that_saving_needs_is_not_given_to_the_update(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(millrace.learner.interrupts, "monotonic", lambda: now[0])
    with Interrupts(20.0) as interrupts:
        assert interrupts.at_most(5.0) == 5
        assert not interrupts.time_is_up(1e9)
        signal.raise_signal(signal.SIGTERM)
        for after_s, save_s, up in (
            (9.9, 1.0, False),
            (10.1, 1.0, True),
            (4.9, 10.0, False),
            (5.1, 10.0, True),
            (0.1, 14.0, True),
        ):
            now[0] = 100 + after_s
            assert interrupts.time_is_up(save_s) == up, (after_s, save_s)
        now[0] = 117.0
        assert interrupts.at_most(5.0) == 3
        now[0] = 130.0
        assert interrupts.at_most(5.0) == 0


def test_a_second_sigterm_changes_nothing_and_a_second_ctrl_c_ends_at_once() -> None:
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    # `raise_signal` signals this thread, so the handler has run when it returns. `os.kill` may choose another thread.
    with Interrupts(20.0) as interrupts:
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
        assert interrupts.received
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    signal.signal(signal.SIGINT, inherited)
    before = signal.getsignal(signal.SIGTERM)
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGTERM)
        assert interrupts.received
        assert signal.getsignal(signal.SIGTERM) == before, "without a grace time, the second one must be able to end it"


@pytest.mark.parametrize("grace_s", [1.5, pytest.param(8.0, marks=pytest.mark.soak)])
def test_a_process_ends_within_its_grace_time_though_a_worker_does_not_leave(stage: Stage, grace_s: float) -> None:
    """The worker is in a step that takes ten minutes."""
    command = [
        sys.executable,
        "-m",
        "millrace",
        "train",
        "tests.system.environments.slow_envs:Slow-v0",
        "--grace-s",
        str(grace_s),
    ]
    command += ["--env-kwargs", "step_s", "600", "--steps", "1000", "--run-dir", str(stage.runs), "--workers", "1"]
    started = stage.start(command, "train")
    workers = stage.runs.glob("*/checkpoints/*.pt")
    deadline = time.monotonic() + START_S * crowding()
    while not list(workers):
        assert time.monotonic() < deadline, started.said()
        time.sleep(0.1)
        workers = stage.runs.glob("*/checkpoints/*.pt")
    time.sleep(2.0)
    began_s = time.monotonic()
    started.signal(signal.SIGTERM)
    assert started.ends() == 130, started.said()
    seconds = time.monotonic() - began_s
    sys.stdout.write(f"\n--grace-s {grace_s:g}: it ended after {seconds:.2f} s\n")
    # It ends the worker when the time is up; then the interpreter exits. Without the limit it would wait for five seconds.
    assert seconds <= grace_s + 1.5 * crowding()


@pytest.mark.soak
@pytest.mark.parametrize("variant", ["ppo, lstm", "dqn, prioritized", "impala"])
def test_a_process_that_gets_sigterm_loses_nothing_and_goes_on_as_if_it_had_not_been_stopped(
    stage: Stage, tmp_path: Path, variant: str
) -> None:
    """Real processes, two workers, SIGTERM at any time; the run that goes on has one worker in this process."""
    settings = {**COMMON, **VARIANTS[variant], "steps": 60 * T * ENVS, "workers": 2, "transport": "ipc"}
    command = [sys.executable, "-m", "millrace", "train"]
    flags = [ENV, "--run-dir", str(stage.runs)]
    for name, value in settings.items():
        match value:
            case bool():
                flags.append(f"--{'' if value else 'no-'}{name.replace('_', '-')}")
            case tuple():
                flags += [f"--{name.replace('_', '-')}", *map(str, value)]
            case _:
                flags += [f"--{name.replace('_', '-')}", str(value)]
    started = stage.start([*command, *flags], "train")
    deadline = time.monotonic() + START_S * crowding()
    while not any(len(read_rows(path)) > 10 for path in stage.runs.glob("*/metrics.jsonl")):
        assert time.monotonic() < deadline, started.said()
        time.sleep(0.01)
    time.sleep(float(np.random.default_rng().uniform(0, 0.1)))
    started.signal(signal.SIGTERM)
    assert started.ends() == 130, started.said()
    (folder,) = stage.runs.iterdir()
    saved = checkpoint.newest(folder)[0].state["past"]["state"]["version"]
    assert saved == read_rows(folder / "metrics.jsonl")[-1]["time/iterations"], "a finished update was lost"
    resumed = stage.start([*command, "--resume", str(folder)], "resumed")
    assert resumed.ends(START_S * crowding()) == 0, resumed.said()
    kept = {name: settings[name] for name in VARIANTS[variant] | {"steps": 0}}
    assert_equal(run(tmp_path / "reference", **kept), folder)
