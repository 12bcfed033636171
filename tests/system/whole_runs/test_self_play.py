"""Runs of self-play, whole: the same bits for any number of workers, the pool of a resumed run, programs, evaluations."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import millrace
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import RunError, UsageError
from tests.system.stage.run_folders import folder_of, policy_of
from tests.system.whole_runs.test_seats import trained

ROCK, PAPER = f"{__name__}:rock", f"{__name__}:paper"
SELF_PLAY: dict[str, Any] = {"self_play": 3, "self_play_save_steps": 100, "rollout_steps": 16, "steps": 800}


def _program(action: int) -> Any:
    def act(obs: Array, state: Floats, rng: np.random.Generator) -> Any:
        return np.full(len(state), action), state, {}

    return SimpleNamespace(act=act)


def rock() -> Any:
    return _program(0)


def paper() -> Any:
    return _program(1)


def broken() -> Any:
    return SimpleNamespace(act=lambda obs, state, rng: 1 / 0)


def pool_of(run: Path) -> Any:
    state = checkpoint.newest(run)[0].state
    arrays = state["opponent_policies"]
    return state["past"]["state"]["opponents"], arrays and [array.numpy().tobytes() for array in arrays]


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("RandomGame", {"max_lag": 1}),
        ("RandomGame", {"core": "gru", "net": (8,), "n_epochs": 1, "self_play_latest": 0.0}),
        ("RandomCrowd", {"algo": "impala", "max_lag": 2, "opponents": (ROCK,)}),
        ("RandomCrowd", {"algo": "dqn", "n_step": 3, "learning_starts": 200}),
        ("RandomCrowd", {"algo": "reinforce", "rollout_steps": 32}),
        ("ChainCrowd", {"opponents": (ROCK,), "critic_keys": ("state",), "seat_id": True}),
    ],
)
def test_weights_pool_and_ratings_do_not_depend_on_the_number_of_workers(
    tmp_path: Path, env: str, settings: dict[str, Any]
) -> None:
    runs = [trained(tmp_path / str(n), env, **SELF_PLAY | settings, workers=n) for n in (1, 2, 4)]
    policies, pools = [policy_of(run) for run in runs], [pool_of(run) for run in runs]
    assert policies[1:] == policies[:1] * 2
    assert pools[1:] == pools[:1] * 2
    assert len(pools[0][0]["snapshots"]) > 3
    assert pools[0][0]["rating"] != 1200


def test_a_resumed_run_has_its_pool_and_goes_on_alike_with_any_number_of_workers(tmp_path: Path) -> None:
    def stops(progress: Progress) -> None:
        if progress.updates == 5:
            raise KeyboardInterrupt

    settings = SELF_PLAY | {"max_lag": 1}
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "first", "RandomGame", watch=stops, **settings)
    first = folder_of(tmp_path / "first")
    before = pool_of(first)
    runs = []
    for workers in (1, 3):
        again = tmp_path / str(workers) / first.name
        shutil.copytree(first, again)
        runs.append(trained(again.parent, "RandomGame", again, workers=workers, **settings))
    assert policy_of(runs[0]) == policy_of(runs[1])
    assert pool_of(runs[0]) == pool_of(runs[1])
    versions = [[each["version"] for each in pool["snapshots"]] for pool in (before[0], pool_of(runs[0])[0])]
    assert versions[0][0] == versions[1][0] == 0
    assert len(versions[0]) > 2


AGAINST_ONE: dict[str, Any] = {"rollout_steps": 32, "learning_rate": 0.02, "steps": 4_000, "normalize_rewards": False}


@pytest.fixture(scope="module")
def plays_paper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    return trained(folder, "RockPaperScissors", opponents=(ROCK,), eval_episodes=20, **AGAINST_ONE)


def test_a_program_is_beaten_and_the_score_says_so(plays_paper: Path) -> None:
    summary = json.loads((plays_paper / "summary.json").read_text())
    assert summary["evaluation"]["facts"]["score"]["mean"] == summary["evaluation"]["return_mean"] == 1
    assert summary["facts_100"]["score"]["mean"] > 0.9
    past, arrays = pool_of(plays_paper)
    assert past["rating"] - 1200 == pytest.approx(1200 - past["scripted"][0])
    assert past["rating"] > 1500
    assert arrays is None


def test_a_run_is_compared_with_another_one_of_another_network(tmp_path: Path, plays_paper: Path) -> None:
    plays_scissors = trained(tmp_path / "b", "RockPaperScissors", opponents=(PAPER,), net=(5,), **AGAINST_ONE)
    rival = shutil.copytree(plays_paper, tmp_path / "rival")
    card = json.loads((rival / "policy.json").read_text())  # its environment is not asked for: it was a script's
    (rival / "policy.json").write_text(json.dumps(card | {"env": "__main__:Mine", "wrappers": ["<Clip>"]}))
    found = [millrace.evaluate(plays_scissors, 60, against=rival, workers=n, transport="inproc") for n in (1, 2)]
    assert found[0] == found[1]
    of_loser = millrace.evaluate(plays_paper, 60, against=plays_scissors, workers=1, transport="inproc")
    for evaluation, low, high in ((found[0], 0.9, 1.0), (of_loser, 0.0, 0.1)):
        score, interval = evaluation.facts["score"].mean, evaluation.score_interval
        assert score is not None
        assert interval is not None
        assert low <= score <= high
        assert 0 <= interval[0] <= score <= interval[1] <= 1
    game = trained(tmp_path / "c", "ChainGame", rollout_steps=16, steps=100)
    with pytest.raises(
        UsageError,
        match=r"^against: expected a policy of .*RockPaper.*, got one of .*ChainGame: with the same agents, \('left'",
    ):
        millrace.evaluate(plays_paper, 2, against=game)


@pytest.mark.parametrize(
    ("env", "settings", "says"),
    [
        ("RockPaperScissors", {"teams": ("left", "right")}, "^teams: expected none without opponents"),
        ("RockPaperScissors", {"self_play": 1, "teams": ("l*",)}, "^teams: expected each agent in one team, got right in 0"),
        ("RockPaperScissors", {"self_play": 1, "info_keys": ("score",)}, "^info_keys: expected another name than score"),
        (
            "RockPaperScissors",
            {"self_play": 1, "info_keys": tuple(map(str, range(32)))},
            "^info_keys: expected fewer than 32",
        ),
        ("RockPaperScissors", {"self_play": 1, "envs": 1, "lanes": 1}, "^self_play: expected envs 2 or more"),
        ("RockPaperScissors", {"opponents": (f"{__name__}:broken",)}, "opponent .*:broken: act raised ZeroDivisionError"),
    ],
)
def test_what_self_play_cannot_have_is_refused_in_a_line(
    tmp_path: Path, env: str, settings: dict[str, Any], says: str
) -> None:
    with pytest.raises((UsageError, RunError), match=says):
        trained(tmp_path, env, rollout_steps=16, steps=300, **settings)


def test_an_environment_of_one_agent_has_no_opponents(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^self_play: expected an environment of several agents, got CartPole-v1$"):
        millrace.train("CartPole-v1", self_play=2, steps=100, run_dir=str(tmp_path), transport="inproc", progress=False)
