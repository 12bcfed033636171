"""Attributes of env copies that a callback sets: when they take effect, for any number of workers, and after a resume."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import psutil
import pytest

import millrace
from millrace import Callback, Progress
from millrace.learner.rollouts.hub import Hub
from millrace.learner.run_folder import checkpoint
from tests.system.stage.preloaded import command_line
from tests.system.stage.run_folders import folder_of, policy_of, saved_rollouts

ENV = "tests.support.users_code.fact_envs:Facts-v0"
SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 4, "envs": 4, "rollout_steps": 32, "n_epochs": 1, "net": (8,),
    "steps": 1000, "eval_episodes": 4, "info_keys": ("level",), "progress": False,
}  # fmt: skip


class Levels(Callback):
    """Sets the level to the number of updates, and keeps the levels of the episodes of each update."""

    def __init__(self, first: float = -1.0, end_at: int = 0) -> None:
        self.first, self.end_at = first, end_at
        self.seen: dict[int, set[float]] = {}
        self.at_start: dict[str, Any] = {}
        self.evaluated: list[float | None] = []

    def on_start(self, progress: Progress) -> None:
        self.at_start = progress.env_attrs
        if not progress.updates:
            progress.set_env_attr("level", self.first)

    def on_update(self, progress: Progress) -> bool:
        self.seen[progress.updates] = {episode.facts[0] for episode in progress.episodes}
        progress.set_env_attr("level", float(progress.updates))
        return progress.updates != self.end_at

    def on_evaluation(self, progress: Progress) -> None:
        assert progress.evaluation is not None
        self.evaluated.append(progress.evaluation.facts["level"].mean)


def run(tmp_path: Path, callback: object, **settings: Any) -> Path:
    env = "" if "resume" in settings else ENV
    return Path(millrace.train(env, run_dir=str(tmp_path / "runs"), callbacks=[callback], **{**SMALL, **settings}))


@pytest.fixture(scope="module")
def one_worker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("one"), Levels())


def test_an_attribute_takes_effect_with_the_next_weights(tmp_path: Path, one_worker: Path) -> None:
    levels = Levels()
    folder = run(tmp_path, levels)
    # The rollouts of update n are of version n - 1, whose weights were sent after update n - 2 was told.
    assert levels.seen == {n: {-1.0 if n <= 2 else n - 2.0} for n in range(1, 10)}
    assert levels.evaluated == [0.0], "evaluation is on env copies as they are made"
    assert policy_of(folder) == policy_of(one_worker)
    assert policy_of(run(tmp_path / "no", Levels(first=5.0))) != policy_of(one_worker), "the level is in the rewards"


@pytest.mark.parametrize("workers", [2, 4])
def test_the_bits_are_the_same_for_any_number_of_workers(tmp_path: Path, one_worker: Path, workers: int) -> None:
    assert policy_of(run(tmp_path, Levels(), workers=workers)) == policy_of(one_worker)


@pytest.mark.parametrize("workers", [1, 2])
def test_the_bits_are_the_same_with_inference_learner(tmp_path: Path, one_worker: Path, workers: int) -> None:
    levels = Levels()
    assert policy_of(run(tmp_path, levels, workers=workers, inference="learner")) == policy_of(one_worker)
    assert levels.evaluated == [0.0]


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_a_resumed_run_goes_on_with_the_attributes(tmp_path: Path, inference: str) -> None:
    before = Levels(end_at=4)
    folder = run(tmp_path, before, inference=inference)
    after = Levels()
    run(tmp_path, after, resume=folder, inference=inference)
    assert after.at_start == {"level": 4.0}, "as it was set last"
    # Version 4 was sent with the level that was set after update 3, and is sent with it again.
    assert after.seen == {n: {n - 2.0} for n in range(5, 10)}


BESIDE: dict[str, Any] = {"max_lag": 1, "eval_every": 400, "eval_workers": 1}


class NewLevel(Callback):
    """The level is new from version 4 on. Interrupts the run after update `until`, or after an evaluation."""

    def __init__(self, until: int = 0, *, after_evaluation: bool = False) -> None:
        self._until = until
        self._after_evaluation = after_evaluation

    def on_start(self, progress: Progress) -> None:
        progress.set_env_attr("level", progress.env_attrs.get("level", 7.0))  # so that there is something to save

    def on_update(self, progress: Progress) -> None:
        if progress.updates == 3:
            progress.set_env_attr("level", 9.0)
        if progress.updates == self._until:
            raise KeyboardInterrupt

    def on_evaluation(self, progress: Progress) -> None:
        if self._after_evaluation:
            raise KeyboardInterrupt


@pytest.mark.parametrize("again", ["while it is awaited", "once it has ended"])
def test_weights_that_act_in_a_round_keep_their_attributes_if_their_evaluation_is_interrupted_again(
    tmp_path: Path, again: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After update 5, version 4 acts in the next round, and is evaluated first in a run without workers for that."""

    def interrupted(hub: Hub, watch: object) -> None:
        raise KeyboardInterrupt

    waits = {**BESIDE, "eval_workers": 0}
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, NewLevel(until=5), **BESIDE)
    folder = folder_of(tmp_path / "runs")
    once = Path(shutil.copytree(folder, tmp_path / "once"))
    run(tmp_path, NewLevel(), resume=once, **waits)
    assert checkpoint.newest(folder)[0].state["past"]["state"]["pending"]["version"] == 4
    assert saved_rollouts(folder).rounds.versions[5] == 4
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        if again == "while it is awaited":
            patch.setattr(Hub, "end_evaluation", interrupted)
        run(tmp_path, NewLevel(after_evaluation=True), resume=folder, **waits)
    run(tmp_path, NewLevel(), resume=folder, **waits)
    assert policy_of(folder) == policy_of(once)


def test_a_run_without_callbacks_goes_on_with_the_attributes_too(tmp_path: Path) -> None:
    class Looks(Callback):
        seen: list[float] = []

        def on_update(self, progress: Progress) -> None:
            self.seen += [episode.facts[0] for episode in progress.episodes]

    folder = run(tmp_path, Levels(end_at=3))
    run(tmp_path, Looks(), resume=folder)
    assert set(Looks.seen) == {2.0, 3.0}


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("levle", 1.0, r"set_env_attr levle: expected an attribute of the environment that is called levle, got none"),
        ("reset", 1.0, r"set_env_attr reset: expected an attribute of the environment that is called reset, got a method"),
    ],
)
@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_an_attribute_that_the_environment_lacks_ends_the_run(
    tmp_path: Path, name: str, value: object, line: str, inference: str
) -> None:
    class Sets(Callback):
        def on_update(self, progress: Progress) -> None:
            progress.set_env_attr(name, value)

    with pytest.raises(millrace.EnvironmentFailed, match=line):
        run(tmp_path, Sets(), max_env_failures=0, inference=inference)


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("_level", 1, "expected the name of a public attribute, got '_level'"),
        ("a b", 1, "expected the name of a public attribute, got 'a b'"),
        ("level", object(), "set_env_attr level: value: expected plain data"),
        ("level", math.sin, "set_env_attr level: value: expected plain data"),
        ("level", "x" * 2_000_000, "expected at most 1,048,576 bytes of attributes, got 2,"),
    ],
)
def test_what_cannot_be_sent_is_refused_where_it_is_set(tmp_path: Path, name: str, value: object, line: str) -> None:
    class Sets(Callback):
        def on_start(self, progress: Progress) -> None:
            with pytest.raises(millrace.UsageError, match=line):
                progress.set_env_attr(name, value)

        def on_update(self, progress: Progress) -> bool:
            return False

    run(tmp_path, Sets(), eval_episodes=1)


def test_no_attribute_is_set_when_it_would_be_lost(tmp_path: Path) -> None:
    refused = []

    class Sets(Callback):
        def on_update(self, progress: Progress) -> bool:
            return False

        def on_checkpoint(self, progress: Progress) -> None:
            self.on_end(progress)

        def on_end(self, progress: Progress) -> None:
            with pytest.raises(millrace.UsageError, match="set_env_attr level: ") as caught:
                progress.set_env_attr("level", 1)
            refused.append(str(caught.value))

    run(tmp_path, Sets(), eval_episodes=1)
    assert refused[0].endswith("the checkpoint would lack it")
    assert refused[-1].endswith("the run has ended")


def test_copies_that_replace_lost_ones_get_the_attributes(tmp_path: Path) -> None:
    """With `--inference learner`, one of two worker processes is killed; the level is set before update 3 and stays."""

    class Kills(Callback):
        def __init__(self) -> None:
            self.seen: list[tuple[int, float]] = []
            self.killed = False

        def on_start(self, progress: Progress) -> None:
            progress.set_env_attr("level", 7.0)

        def on_update(self, progress: Progress) -> None:
            self.seen += [(progress.updates, episode.facts[0]) for episode in progress.episodes if episode.length]
            if progress.updates == 3:
                workers = [child for child in psutil.Process().children() if "millrace.workers" in command_line(child)]
                workers[0].kill()
                self.killed = True

    kills = Kills()
    run(tmp_path, kills, inference="learner", workers=2, transport="ipc", steps=3000, eval_episodes=1)
    assert kills.killed
    late = [level for update, level in kills.seen if update > 8]
    assert len(late) > 50
    assert set(late) == {7.0}
