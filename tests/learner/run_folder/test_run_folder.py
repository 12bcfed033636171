"""The run folder and what stands in it: whole files, the same bytes for the same policy, curves that never go back."""

import errno
import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from millrace.learner.config.config import Config
from millrace.learner.config.layers import config_of_run, resolve
from millrace.learner.run_folder.episode_window import EpisodeWindow
from millrace.learner.run_folder.metrics_log import MetricsLog, read_rows
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import Evaluation, Summary
from millrace.learner.run_folder.run_folder import RunFolder, as_folder_name
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import RunError, UsageError
from millrace.protocol.policy.layout import acting_size, buffer_size, parameter_layout, total_size
from millrace.protocol.rollout import Episode
from millrace.protocol.specs import PolicySpec
from tests.support.in_process.saved_policies import policy_run

STARTED_S = 1_700_000_000.0


def config(folder: Path, env: str = "CartPole-v1") -> Config:
    return resolve(env, run_dir=str(folder), seed=3)


def pendulum_like(bound: float) -> PolicySpec:
    return PolicySpec(
        observation_leaves(spaces.Box(-1, 1, (3,))),
        action_spec(spaces.Box(-bound, bound, (2,))),
        net=(8,),
        normalize_observations=True,
    )


def weights(spec: PolicySpec) -> tuple[np.ndarray, np.ndarray]:
    acting, critic = parameter_layout(spec)
    rng = np.random.default_rng(0)
    return (
        rng.standard_normal(total_size(acting) + total_size(critic), dtype=np.float32),
        rng.random(buffer_size(spec), dtype=np.float32),
    )


def test_a_run_has_a_folder_of_its_own(tmp_path: Path) -> None:
    folder = RunFolder.create(config(tmp_path), STARTED_S)
    assert folder.path.parent == tmp_path
    assert folder.path.name.startswith("CartPole-v1-ppo-s3-202311")
    assert config_of_run(folder.path) == config(tmp_path)
    (folder.path / "mine.txt").write_text("mine")
    later = [RunFolder.create(config(tmp_path), STARTED_S) for _ in range(2)]
    assert [run.path.name for run in later] == [f"{folder.path.name}-2", f"{folder.path.name}-3"]
    assert (folder.path / "mine.txt").read_text() == "mine"


def test_runs_that_start_in_the_same_second_have_folders_of_their_own(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as threads:
        made = list(threads.map(lambda _: RunFolder.create(config(tmp_path / "runs"), STARTED_S).path, range(32)))
    assert len(set(made)) == 32
    assert all(config_of_run(path) == config(tmp_path / "runs") for path in made)


def test_a_run_that_does_not_begin_removes_only_its_own_folder(tmp_path: Path) -> None:
    """Both were made in a folder that was not there before."""
    first, second = (RunFolder.create(config(tmp_path / "a" / "runs"), STARTED_S) for _ in range(2))
    first.remove()
    assert second.path.is_dir()
    assert not first.path.exists()
    alone = RunFolder.create(config(tmp_path / "b" / "runs"), STARTED_S)
    alone.remove()
    assert not (tmp_path / "b").exists()
    assert tmp_path.is_dir()
    begun = RunFolder.create(config(tmp_path / "c"), STARTED_S)
    begun.keep()
    begun.remove()
    assert begun.path.is_dir()


@pytest.mark.parametrize(
    ("env", "name"),
    [("ALE/Pong-v5", "ALE-Pong-v5"), ("my.envs:My Env-v0", "my.envs-My-Env-v0"), ("../../etc", "etc"), ("/", "env")],
)
def test_no_environment_leads_out_of_the_folder(env: str, name: str) -> None:
    assert as_folder_name(env) == name


def test_what_is_no_run_folder_is_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        RunFolder.open(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=r"expected a run folder, got one without config\.toml"):
        RunFolder.open(tmp_path)
    run = RunFolder.create(config(tmp_path)).path
    with pytest.raises(UsageError, match=rf"it holds runs: name one of them, such as .*/{run.name}$"):
        RunFolder.open(tmp_path)
    with pytest.raises(UsageError, match=r"cannot be made: Not a directory; choose another --run-dir"):
        (tmp_path / "file").touch()
        RunFolder.create(config(tmp_path / "file"))


@pytest.mark.parametrize("bound", [2.0, np.inf])
def test_a_policy_comes_back_as_it_was(tmp_path: Path, bound: float) -> None:
    spec = pendulum_like(bound)
    parameters, buffers = weights(spec)
    folder = RunFolder(tmp_path)
    env = EnvSpec("Mine-v0", {"g": 9.8}, eval_kwargs={"g": 1.6})
    folder.write_policy(policy_run(spec, env), parameters, buffers)
    card, acting, normal = folder.read_policy()
    assert (card.policy, card.env, card.env_kwargs, card.eval_env_kwargs) == (spec, "Mine-v0", {"g": 9.8}, {"g": 1.6})
    assert acting.tobytes() == parameters[: acting_size(spec)].tobytes()
    assert normal.tobytes() == buffers.tobytes()


def test_another_program_can_act_from_the_two_files(tmp_path: Path) -> None:
    """With safetensors and json alone: names, shapes and offsets say where each array stood."""
    from safetensors.numpy import load_file

    spec = pendulum_like(2.0)
    parameters, buffers = weights(spec)
    RunFolder(tmp_path).write_policy(policy_run(spec, EnvSpec("Mine-v0")), parameters, buffers)
    arrays = load_file(tmp_path / "policy.safetensors")
    card = json.loads((tmp_path / "policy.json").read_text())
    assert [entry["name"] for entry in card["arrays"]] == [
        "actor.0.weight", "actor.0.bias", "actor.out.weight", "actor.out.bias", "actor.log_std",
    ]  # fmt: skip
    assert set(arrays) == {entry["name"] for entry in card["arrays"]} | {"observation_mean", "observation_std"}
    for entry in card["arrays"]:
        count = int(np.prod(entry["shape"]))
        there = parameters[entry["offset"] : entry["offset"] + count].reshape(entry["shape"])
        assert np.array_equal(arrays[entry["name"]], there)
    assert np.array_equal(np.concatenate([arrays["observation_mean"], arrays["observation_std"]]), buffers)


def test_the_same_policy_gives_the_same_bytes(tmp_path: Path) -> None:
    spec = pendulum_like(2.0)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        RunFolder(tmp_path / name).write_policy(policy_run(spec, EnvSpec("Mine-v0")), *weights(spec))
    for name in ("policy.safetensors", "policy.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_policy_that_does_not_fit_its_card_is_refused(tmp_path: Path) -> None:
    spec = pendulum_like(2.0)
    folder = RunFolder(tmp_path)
    with pytest.raises(UsageError, match="has the run saved its policy yet"):
        folder.read_policy()
    folder.write_policy(policy_run(spec, EnvSpec("Mine-v0")), *weights(spec))
    with pytest.raises(UsageError, match=r"expected the best policy, best\.safetensors, got none"):
        folder.read_policy("best")
    card = tmp_path / "policy.json"
    whole = card.read_text()
    card.write_text(whole.replace('"net": [\n      8', '"net": [\n      9'))
    with pytest.raises(UsageError, match=r"actor\.0\.bias: expected float32 \(9,\), got \(8,\)"):
        folder.read_policy()
    card.write_text(whole.replace('"format": 3', '"format": 2'))
    with pytest.raises(UsageError, match="expected format 3, got 2; install the millrace that wrote it"):
        folder.read_policy()
    card.write_text(whole)
    (tmp_path / "policy.safetensors").write_bytes((tmp_path / "policy.safetensors").read_bytes()[:-4])
    with pytest.raises(UsageError, match="cannot be read"):
        folder.read_policy()


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder(tmp_path)
    summary = Summary(
        env="CartPole-v1", algo="ppo", seed=1, env_steps=10, updates=1, wall_s=0.5, env_steps_per_s=20.0,
        stop_reason="finished", return_mean_100=None, ledger={"used": 1}, stages={"update": 0.2},
        evaluation=Evaluation(episodes=2, return_mean=9.5, return_std=0.5, length_mean=9.5),
    )  # fmt: skip
    folder.write_summary(summary)
    before = (tmp_path / "summary.json").read_text()
    assert json.loads(before)["evaluation"]["return_mean"] == 9.5
    assert json.loads(before)["return_mean_100"] is None

    def fails(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("millrace.learner.run_folder.regular_files.os.fsync", fails)
    with pytest.raises(RunError, match=r"summary\.json not written: No space left on device"):
        folder.write_summary(summary)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["summary.json"]
    assert (tmp_path / "summary.json").read_text() == before


def test_a_row_has_the_names_that_users_know(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    progress = Progress(
        env_steps=256, updates=1, wall_s=2.0, steps_per_s=128.0, return_mean=20.5, length_mean=20.0, lag_mean=0.5,
        lag_max=1, ledger={"issued": 8, "used": 7, "lost": 1}, stages={"update": 0.5},
    )  # fmt: skip
    log.write(progress, {"train/approx_kl": 0.01, "loss": float("nan")})
    log.close()
    (row,) = read_rows(tmp_path / "metrics.jsonl")
    assert row == {
        "rollout/ep_rew_mean": 20.5, "rollout/ep_len_mean": 20.0, "time/fps": 128.0, "time/iterations": 1,
        "time/time_elapsed": 2.0, "time/total_timesteps": 256, "lag/mean": 0.5, "lag/max": 1,
        "ledger/issued": 8, "ledger/used": 7, "ledger/lost": 1, "stage/update": 0.5, "train/approx_kl": 0.01,
        "train/loss": None,
    }  # fmt: skip


def test_a_resumed_run_takes_back_what_its_checkpoint_does_not_know(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    for steps in (100, 200, 300, 400):
        log.write(Progress(env_steps=steps, return_mean=1.0), {})
    log.close()
    with (tmp_path / "metrics.jsonl").open("ab") as file:
        file.write(b'{"time/total_timesteps": 50')  # killed in mid-row
    log = MetricsLog(tmp_path, from_env_steps=200)
    assert log.removed == 2
    for steps in (250, 350):
        log.write(Progress(env_steps=steps, return_mean=2.0), {})
    log.close()
    assert [row["time/total_timesteps"] for row in read_rows(tmp_path / "metrics.jsonl")] == [100, 200, 250, 350]


def test_a_resumed_run_takes_back_updates_that_only_reset_env_copies(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    for update, steps in ((1, 1), (2, 2), (3, 2), (4, 2), (5, 3)):
        log.write(Progress(updates=update, env_steps=steps), {})
    log.close()
    log = MetricsLog(tmp_path, from_env_steps=2, from_update=2)
    assert log.removed == 3
    for update in (3, 4):
        log.write(Progress(updates=update, env_steps=2), {})
    log.close()
    assert [row["time/iterations"] for row in read_rows(tmp_path / "metrics.jsonl")] == [1, 2, 3, 4]


@pytest.mark.parametrize("added", [{"eval/mean_reward": 7.0}, {"train/loss": 12.5}, {"train/loss": None}])
def test_a_row_that_gets_more_numbers_is_never_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, added: dict[str, float | None]
) -> None:
    """The run is killed after any number of bytes, and resumed from its checkpoint of the same update."""
    pwrite = os.pwrite
    path = tmp_path / "metrics.jsonl"
    progress = Progress(updates=2, env_steps=20, return_mean=1.5)

    class Killed(BaseException):
        pass

    def killed(file: int, record: bytes, offset: int) -> int:
        pwrite(file, record[:taken], offset)
        raise Killed

    taken = 0
    while taken < 40:
        path.unlink(missing_ok=True)
        log = MetricsLog(tmp_path)
        for updates in (1, 2):
            log.write(Progress(updates=updates, env_steps=10 * updates, return_mean=1.5), {"n_updates": 3, "loss": 0.25})
        log.flush()
        before = read_rows(path)
        log.write(progress, added)
        with monkeypatch.context() as patched, pytest.raises(Killed):
            patched.setattr(os, "pwrite", killed)
            log.flush()
        log._table.close()
        log = MetricsLog(tmp_path, from_env_steps=20, from_update=2)
        rows = read_rows(path)
        assert len(rows) == 2
        assert rows[0] == before[0]
        assert rows[1].items() <= before[1].items() | added.items(), "a number is wrong"
        assert before[1].keys() - rows[1].keys() <= {*added}, "only a number that was being replaced may be missing"
        log.write(progress, added)
        log.close()
        assert read_rows(path) == [before[0], before[1] | added]
        taken += 1


def test_a_row_that_is_cut_off_before_its_update_is_known_is_dropped(tmp_path: Path) -> None:
    for content in (b'{"a":1', b'{"time/total_timesteps":5,"a":1', b"{" + b'"a":1,' * 99, b"," * 99):
        (tmp_path / "metrics.jsonl").write_bytes(content)
        log = MetricsLog(tmp_path, from_env_steps=20, from_update=2)
        log.close()
        assert (tmp_path / "metrics.jsonl").read_bytes() == b""


def test_rows_that_the_disk_refuses_are_written_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = MetricsLog(tmp_path)
    log.write(Progress(updates=1, env_steps=100), {})
    log.flush()
    appender = log._table
    file = appender._file
    took: list[int] = []

    class Full:
        """Takes ten bytes and no more."""

        def write(self, record: bytes) -> int:
            if took:
                raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))
            took.append(file.write(record[:10]))
            return took[0]

        def truncate(self, length: int) -> None:
            took.clear()
            file.truncate(length)

    pwrite = os.pwrite

    def full(number: int, record: bytes, offset: int) -> int:
        if offset + len(record) > len(first):
            if took:
                raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))
            took.append(pwrite(number, record[:10], offset))
            return took[0]
        return pwrite(number, record, offset)

    first = (tmp_path / "metrics.jsonl").read_bytes()
    log.write(Progress(updates=1, env_steps=100), {"eval/mean_reward": 3.0})
    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", full)
        for _ in range(2):
            with pytest.raises(RunError, match=r"metrics\.jsonl: rows are not written yet: Disk quota exceeded$"):
                log.flush()
            assert (tmp_path / "metrics.jsonl").read_bytes() == first
            took.clear()
    log.flush()
    first = (tmp_path / "metrics.jsonl").read_bytes()
    appender._file = Full()  # type: ignore[assignment]
    log.write(Progress(updates=2, env_steps=200), {})
    for updates in (2, 3):
        with pytest.raises(RunError, match=r"metrics\.jsonl: rows are not written yet: Disk quota exceeded$"):
            log.flush()
        log.write(Progress(updates=updates, env_steps=100 * updates), {})
    assert (tmp_path / "metrics.jsonl").read_bytes() == first, "a part of a row is left"
    log.write(Progress(updates=3, env_steps=300), {"eval/mean_reward": 5.0})
    appender._file = file
    log.flush()
    log.close()
    rows = read_rows(tmp_path / "metrics.jsonl")
    assert [row["time/total_timesteps"] for row in rows] == [100, 200, 300]
    assert [row.get("eval/mean_reward") for row in rows] == [3.0, None, 5.0]


def test_the_window_holds_the_last_hundred_episodes() -> None:
    window = EpisodeWindow()
    assert window.return_mean is None
    assert window.length_mean is None
    window.extend([Episode(float(i), 2 * i, 0.0) for i in range(150)])
    window.extend([])
    assert window.return_mean == np.mean(range(50, 150))
    assert window.length_mean == 2 * np.mean(range(50, 150))
    again = EpisodeWindow.from_state(window.state())
    assert again.return_mean == window.return_mean
    again.extend([Episode(0.0, 0, 0.0)])
    assert again.return_mean == (np.sum(range(51, 150))) / 100


def test_a_resumed_run_adds_an_evaluation_to_the_row_of_its_update(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    for update in (1, 2, 3):
        log.write(Progress(updates=update, env_steps=10 * update, lag_max=2), {"loss": 0.5})
    log.close()
    log = MetricsLog(tmp_path, from_env_steps=20)
    log.write(Progress(updates=2, env_steps=20), {"eval/mean_reward": 7.0})
    log.write(Progress(updates=3, env_steps=30), {"loss": 0.25})
    log.close()
    first, second, third = read_rows(tmp_path / "metrics.jsonl")
    assert (second["time/iterations"], second["train/loss"], second["lag/max"], second["eval/mean_reward"]) == (2, 0.5, 2, 7)
    assert (third["time/iterations"], third["train/loss"]) == (3, 0.25)
    assert "eval/mean_reward" not in first | third


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"info_keys": [f"f{n}" for n in range(33)]}, "length <= 32"),
        ({"env": "a\nb"}, "matching regex"),
        ({"policy": {"action": {"dtype": "object"}}}, "action: expected a dtype"),
        ({"policy": {"action": {"dtype": "int64"}}}, "action: expected a dtype"),
        ({"policy": {"action": {"low": []}}}, "expected 2 lower and upper bounds, got 0 and 2"),
        ({"policy": {"action": {"shape": [-1]}}}, r"Expected `int` >= 0 - at `\$\.policy\.action\.shape"),
        ({"policy": {"action": {"shape": [1] * 9}}}, "Expected `array` of length <= 8"),
        ({"policy": {"action": {"shape": [2**40]}}}, "action: expected a shape"),
        ({"policy": {"action": {"kind": "multidiscrete", "dtype": "int64"}}}, "expected 2 sizes and starts, got 0 and 0"),
        ({"policy": {"head": "q"}}, "expected a discrete action, got box"),
        ({"policy": {"observation": []}}, "expected 1 to 48 arrays"),
        ({"policy": {"net": [0]}}, "expected a network"),
        ({"policy": {"net": [1 << 30]}}, "expected weights of at most"),
        ({"policy": {"core": "lstm", "core_size": -1}}, "expected a network"),
        ({"policy": {"own": {"factory": "os:system", "arrays": []}}}, "expected a network"),
    ],
)
def test_a_description_of_which_no_policy_can_be_made_is_one_line(tmp_path: Path, wrong: dict[str, Any], said: str) -> None:
    spec = pendulum_like(2.0)
    RunFolder(tmp_path).write_policy(policy_run(spec, EnvSpec("Mine-v0")), *weights(spec))
    card = json.loads((tmp_path / "policy.json").read_text())

    def changed(whole: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
        deeper = {key: isinstance(value, dict) and bool(whole[key]) for key, value in part.items()}
        return whole | {key: changed(whole[key], value) if deeper[key] else value for key, value in part.items()}

    (tmp_path / "policy.json").write_text(json.dumps(changed(card, wrong)))
    with pytest.raises(UsageError, match=f"cannot be read: .*{said}"):
        RunFolder(tmp_path).read_policy()


def test_a_summary_that_cannot_be_removed_is_one_line(tmp_path: Path) -> None:
    folder = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path)))
    (folder.path / "summary.json").mkdir()
    with pytest.raises(RunError, match=r"summary\.json cannot be removed: .*directory; remove it, then resume the run"):
        folder.remove_summary()
