"""Workers are killed; environments raise, hang or die. The vector environment reports it in time and leaves nothing open."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import psutil
import pytest
from gymnasium.vector import AutoresetMode

import millrace
from millrace.launch import vector
from millrace.learner.vector_env import settings
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.protocol.call_timeouts import CallTimeouts
from millrace.protocol.env_spec import EnvLike
from millrace.protocol.errors import EnvironmentFailed, NoWorkers, UserFacingError, WorkerLost
from millrace.protocol.keys.key_folder import KeyFolder
from tests.system.stage.preloaded import command_line
from tests.system.stage.processes import START_S, Worker, free_port, wait_for

SHARED_MEMORY = {"shared": True, "messages": False}
ZEROS = np.zeros(4, np.int64)
CLOSES_WITHIN_S = 8.0
HANGS = "tests.support.envs.toy:Hangs-v0"


@pytest.fixture(params=SHARED_MEMORY)
def shared_memory(request: pytest.FixtureRequest) -> bool:
    return SHARED_MEMORY[request.param]


def make(env: EnvLike = "CartPole-v1", **keywords: Any) -> ZmqVectorEnv:
    return millrace.make_vec(env, 4, **{"workers": 2, "timeout": 20.0, **keywords})


def local_workers() -> list[psutil.Process]:
    """Worker processes that are children of this process, in the order of their names."""
    found = [(command_line(child), child) for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
    named = [(line[line.index("--name") + 1], child) for line, child in found if "--name" in line]
    return [child for _, child in sorted(named, key=lambda pair: pair[0])]


def close_and_check(env: ZmqVectorEnv) -> None:
    """Close the environment twice, in time. No worker process must be left."""
    began = time.monotonic()
    env.close()
    env.close()
    assert time.monotonic() - began < CLOSES_WITHIN_S
    assert local_workers() == []


def open_descriptors() -> int:
    return psutil.Process().num_fds()


def test_a_worker_killed_between_steps_comes_back_truncated(shared_memory: bool) -> None:
    env = make(shared_memory=shared_memory)
    env.reset(seed=1)
    before = env.step(ZEROS)[0]
    local_workers()[1].kill()
    obs, reward, terminated, truncated, infos = env.step(ZEROS)
    assert truncated.tolist() == [False, False, True, True]
    assert not terminated.any()
    assert reward.tolist() == [1.0, 1.0, 0.0, 0.0]
    assert (obs[2:] == before[2:]).all()
    assert (obs[:2] != before[:2]).any()
    assert infos["worker_lost"].tolist() == [False, False, True, True]
    obs, reward, terminated, truncated, infos = env.step(ZEROS)  # this step resets the lost copies
    assert reward.tolist() == [1.0, 1.0, 0.0, 0.0]
    assert not truncated.any()
    assert "worker_lost" not in infos
    assert (np.abs(obs[2:]) <= 0.05).all()
    assert env.step(ZEROS)[1].tolist() == [1.0] * 4
    close_and_check(env)


def test_a_loss_is_reported_beside_infos_too_long_for_shared_memory() -> None:
    env = make("tests.support.envs.toy:Informs-v0", wordy=1_000_000)
    env.reset(seed=1)
    action = env.action_space.sample()
    assert "worker_lost" not in env.step(action)[4]
    local_workers()[1].kill()
    infos = env.step(action)[4]
    assert infos["worker_lost"].tolist() == [False, False, True, True]
    assert [len(word or "") > 1_000_000 for word in infos["word"]] == [True, True, False, False]
    assert "worker_lost" not in env.step(action)[4]
    close_and_check(env)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_a_lost_worker_is_truncated_in_the_other_autoreset_modes(mode: AutoresetMode) -> None:
    env = make(autoreset_mode=mode)
    env.reset(seed=1)
    before = env.step(ZEROS)[0]
    local_workers()[0].kill()
    obs, _, _, truncated, infos = env.step(ZEROS)
    assert truncated.tolist() == [True, True, False, False]
    if mode is AutoresetMode.SAME_STEP:
        assert (infos["final_obs"][0] == before[0]).all()
        assert infos["final_info"]["worker_lost"].tolist() == [True, True, False, False]
        assert (np.abs(obs[:2]) <= 0.05).all()
    else:
        assert (obs[:2] == before[:2]).all()
        env.reset(options={"reset_mask": truncated})
    assert env.step(ZEROS)[1].tolist() == [1.0] * 4
    close_and_check(env)


def test_a_worker_that_dies_during_a_step_is_noticed_at_once(tmp_path: Path, shared_memory: bool) -> None:
    env = make("tests.support.envs.toy:Dies-v0", after=2, once=str(tmp_path / "once"), k=50, shared_memory=shared_memory)
    env.reset(seed=1)
    began = time.monotonic()
    truncated = [env.step(ZEROS)[3] for _ in range(4)]
    assert time.monotonic() - began < 10.0
    assert sum(int(row.any()) for row in truncated) == 1
    assert truncated[2].sum() == 2
    close_and_check(env)


@pytest.mark.parametrize("allowed", [0, 2])
def test_an_environment_that_ends_its_workers_again_and_again_ends_the_vector_environment(
    allowed: int, caplog: pytest.LogCaptureFixture
) -> None:
    env = make("tests.support.envs.toy:Dies-v0", after=2, k=50, workers=1, max_env_failures=allowed)
    env.reset(seed=1)
    why = rf"^worker w0 \(.*\): its process .* SIGKILL.*; max_env_failures allows {allowed}"
    with pytest.raises(EnvironmentFailed, match=why):
        for _ in range(100):
            env.step(ZEROS)
    assert sum("counts as a failure" in line for line in caplog.messages) == allowed + 1
    close_and_check(env)


def test_a_lane_that_answered_before_its_worker_died_is_reported_in_the_next_step(tmp_path: Path) -> None:
    once = str(tmp_path / "once")
    env = make("tests.support.envs.toy:Dies-v0", after=2, once=once, k=50, only_seed=3, workers=1, lanes=2)
    env.reset(seed=1)  # copy 2 has seed 3: its lane, the second, dies after the first lane has stepped
    results = [env.step(ZEROS) for _ in range(6)]
    assert [step[3].tolist() for step in results[:3]] == [[False] * 4, [False] * 4, [False, False, True, True]]
    assert [step[3][:2].all() for step in results] == [False, False, False, True, False, False]
    remaining = np.array([step[0][:, 0] for step in results])  # falls by 1/50, unless the episode ended 1 or 2 steps before
    for n in range(4):
        for t in range(1, 6):
            if not any(step[3][n] for step in results[max(0, t - 1) : t + 1]):
                assert remaining[t, n] == pytest.approx(remaining[t - 1, n] - 0.02), "an episode began without a report"
    close_and_check(env)


def test_a_loss_is_raised_with_on_worker_loss_raise(shared_memory: bool) -> None:
    env = make(on_worker_loss="raise", shared_memory=shared_memory)
    env.reset(seed=1)
    local_workers()[1].kill()
    with pytest.raises(WorkerLost, match=r"worker w1 \(.*\) was killed by SIGKILL: lane 1 \(copies 2 to 3\) is lost"):
        env.step(ZEROS)
    with pytest.raises(WorkerLost, match="call reset"):
        env.step(ZEROS)
    env.reset(seed=1)
    assert env.step(ZEROS)[1].tolist() == [1.0] * 4
    close_and_check(env)


def test_an_error_of_an_environment_has_the_traceback_of_the_worker() -> None:
    env = make("tests.support.envs.toy:Raises-v0", after=2)
    env.reset(seed=1)
    with pytest.raises(EnvironmentFailed, match=r"lane \d, copy 0, step 2: its environment raised ValueError") as raised:
        for _ in range(4):
            env.step(ZEROS)
    assert "the toy is broken, as it was asked to be" in raised.value.detail
    cause = raised.value.__cause__
    assert (type(cause), str(cause)) == (ValueError, "the toy is broken, as it was asked to be")
    assert "in fault" in "".join(traceback.format_exception(raised.value))
    env.reset(seed=1)  # makes new copies
    assert env.step(ZEROS)[1].tolist() == [1.0] * 4
    close_and_check(env)


def test_an_environment_that_cannot_be_made_in_a_worker_says_why() -> None:
    this_process = os.getpid()

    def only_here() -> gymnasium.Env[Any, Any]:
        if os.getpid() != this_process:
            raise OSError("no licence on this machine")
        return gymnasium.make("CartPole-v1")

    with pytest.raises(EnvironmentFailed, match="no licence on this machine") as raised:
        make(only_here)
    assert "in only_here" in raised.value.detail
    assert local_workers() == []


@pytest.mark.parametrize("loss", ["truncate", "raise"])
def test_a_worker_whose_environment_hangs_is_lost_at_the_deadline(tmp_path: Path, loss: str) -> None:
    once = str(tmp_path / "once")
    env = make(HANGS, after=1, once=once, timeout=1.5, on_worker_loss=loss)
    env.reset(seed=1)
    env.step(ZEROS)
    began = time.monotonic()
    if loss == "truncate":
        truncated = env.step(ZEROS)[3]
        assert truncated.sum() == 2
        assert env.step(ZEROS)[1][~truncated].tolist() == [1.0, 1.0]
    else:
        with pytest.raises(WorkerLost, match="did not answer"):
            env.step(ZEROS)
    assert 1.0 < time.monotonic() - began < 8.0
    close_and_check(env)


def test_close_returns_while_an_environment_hangs() -> None:
    env = make(HANGS, after=0)
    env.reset(seed=1)
    env.step_async(ZEROS)
    close_and_check(env)


def test_a_stopped_worker_is_lost_at_the_deadline() -> None:
    env = make(timeout=1.0)
    env.reset(seed=1)
    local_workers()[0].send_signal(signal.SIGSTOP)
    assert env.step(ZEROS)[3].tolist() == [True, True, False, False]
    env._send_recv.timeout_s = 20.0
    assert not env.step(ZEROS)[3].any()
    close_and_check(env)


def test_a_reset_is_repeated_when_workers_are_lost() -> None:
    env = make()
    env.reset(seed=1)
    for worker in local_workers():
        worker.kill()
    obs, _ = env.reset(seed=1)
    theirs = gymnasium.make_vec("CartPole-v1", 4, vectorization_mode="sync")
    assert (obs == theirs.reset(seed=1)[0]).all()
    theirs.close()
    assert env.step(ZEROS)[1].tolist() == [1.0] * 4
    close_and_check(env)


# ---------------------------------------------------------------- send and recv


def test_a_loop_by_recv_does_not_wait_for_a_copy_that_hangs(tmp_path: Path, shared_memory: bool) -> None:
    env = make(HANGS, after=1, once=str(tmp_path / "once"), only_seed=2, k=50, workers=4, lanes=4,
               timeout=60.0, shared_memory=shared_memory)  # fmt: skip
    env.reset_async(seed=1)
    rows = dict.fromkeys(range(4), 0)
    deadline = time.monotonic() + 60.0
    while min(rows[n] for n in (0, 2, 3)) < 100 and time.monotonic() < deadline:
        ids = env.recv()[4]["env_id"]
        for n in ids.tolist():
            rows[n] += 1
        env.send(np.zeros(len(ids), np.int64), ids)
    assert rows[1] == 2, "its reset and its first step"
    assert min(rows[n] for n in (0, 2, 3)) >= 100, rows
    close_and_check(env)


def test_recv_reports_a_worker_that_is_killed_or_hangs_and_goes_on(tmp_path: Path, shared_memory: bool) -> None:
    env = make(HANGS, after=3, once=str(tmp_path / "once"), only_seed=2, k=50, workers=4, lanes=4,
               timeout=10.0, shared_memory=shared_memory)  # fmt: skip
    env.reset_async(seed=1)
    local_workers()[3].kill()  # perhaps during its reset, which is then repeated
    lost, rows, after_losses = [0] * 4, 0, 0
    began = time.monotonic()
    while after_losses < 200 and time.monotonic() - began < 60.0:
        _, reward, _, truncated, infos = env.recv()
        ids = infos["env_id"]
        rows += len(ids)
        if "worker_lost" in infos:
            assert (truncated == infos["worker_lost"]).all()
            assert not reward[infos["worker_lost"]].any()
            for n in ids[infos["worker_lost"]]:
                lost[n] += 1
        after_losses += lost[1] > 0
        if not lost[1]:
            time.sleep(0.01)  # ten seconds of steps at full speed would take the core from other tests
        env.send(np.zeros(len(ids), np.int64), ids)
    assert after_losses == 200
    assert (lost[0], lost[1], lost[2]) == (0, 1, 0)
    assert lost[3] <= 1
    close_and_check(env)


def test_close_does_not_wait_for_what_was_sent() -> None:
    env = make(HANGS, after=0, workers=4, lanes=4)
    env.reset_async(seed=1)
    env.recv(4)
    env.send(ZEROS)
    close_and_check(env)


def test_many_environments_leave_nothing_open() -> None:
    def use_one() -> None:
        with make() as env:
            env.reset(seed=1)
            env.step(ZEROS)

    use_one()
    descriptors, shared_files = open_descriptors(), set(os.listdir("/dev/shm"))
    for _ in range(3):
        use_one()
    assert open_descriptors() <= descriptors
    assert set(os.listdir("/dev/shm")) <= shared_files


def test_make_vec_fails_if_no_worker_joins() -> None:
    env: ZmqVectorEnv | None = None
    with pytest.raises(NoWorkers, match=r"waited 0.5 s for 1 worker at tcp://127.0.0.1:\d+, 0 joined; start one"):
        env = make(workers=0, lanes=2, bind="tcp://127.0.0.1:*", timeout=0.5)
    assert env is None


SCRIPT = """
import os, sys, numpy as np, millrace
if __name__ == "__main__":
    env = millrace.make_vec("CartPole-v1", 4, workers=2)
    env.reset(seed=1)
    env.step(np.zeros(4, int))
    print("ready", flush=True)
    {end}
"""
ENDS = {
    "at interpreter exit": "pass",
    "after an exception": "raise SystemExit(3)",
    "when it is deleted": "del env",
    "killed": "os.kill(os.getpid(), 9)",
}


@pytest.mark.parametrize("end", ENDS)
def test_no_process_outlives_the_learner(end: str, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(end=ENDS[end]))
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    before = set(os.listdir("/dev/shm"))
    with subprocess.Popen([sys.executable, str(script)], env=env, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        with suppress(psutil.NoSuchProcess):
            children = psutil.Process(process.pid).children() if end == "killed" else []
        process.wait(15)
    gone, alive = psutil.wait_procs(children, timeout=10)
    assert not alive, gone
    # Of a killed learner, a child of a child removes the folder.
    wait_for(lambda: not list((tmp_path / "tmp").iterdir()), 10, "an empty folder of temporary files")
    assert set(os.listdir("/dev/shm")) <= before


FORKS = """
import os, sys
import numpy as np
import millrace

if __name__ == "__main__":
    env = millrace.make_vec("CartPole-v1", 4, workers=1)
    env.reset(seed=1)
    if os.fork() == 0:
        sys.exit(0)
    os.wait()
    assert os.path.exists(env.address.removeprefix("ipc://")), "a replacement would find no socket"
    *_, infos = env.step(np.zeros(4, int))
    assert "worker_lost" not in infos
    env.close()
    print("stepped")
"""


def test_a_forked_child_that_ends_leaves_the_workers_and_their_socket_alone(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(FORKS)
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    ended = subprocess.run([sys.executable, str(script)], env=env, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (0, "stepped\n"), ended.stderr


def test_workers_elsewhere_join_by_tcp_and_come_back(elsewhere: Elsewhere) -> None:
    """The test starts the workers, which join over TCP. One is killed, and another takes its place."""
    elsewhere.start("a")
    elsewhere.start("b")
    with make(workers=0, lanes=2, bind=elsewhere.address, timeout=START_S) as env:
        env._send_recv.timeout_s = 3.0
        env.reset(seed=1)
        assert env.step(ZEROS)[1].tolist() == [1.0] * 4
        elsewhere.start("c")
        elsewhere.started[0].kill()
        rows = [env.step(ZEROS) for _ in range(3)]
        assert [row[3].any() for row in rows] == [True, False, False]
        assert rows[-1][1].tolist() == [1.0] * 4
    assert [worker.process.wait(10) for worker in elsewhere.started] == [-9, 0, 0]


# ---------------------------------------------------------------- workers elsewhere: keys, code and hangs


class Elsewhere:
    """Workers that the test starts itself, each with its supervisor. Their output goes to a file."""

    def __init__(self, folder: Path) -> None:
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self.started: list[Worker] = []
        self._said = folder / "said"

    def start(self, name: str, *flags: str) -> None:
        command = [sys.executable, "-m", "millrace.workers", self.address, "--name", name, *flags]
        self.started.append(Worker(command, self._said))

    def said(self) -> str:
        return self._said.read_text()


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Elsewhere]:
    monkeypatch.setenv("HOME", str(tmp_path))
    for variable in ("MILLRACE_KEYS", "MILLRACE_TOKEN"):
        monkeypatch.delenv(variable, raising=False)
    elsewhere = Elsewhere(tmp_path)
    yield elsewhere
    for worker in elsewhere.started:
        if worker.alive():
            worker.go_on()  # a failed test may have left it stopped
            worker.process.terminate()
    for worker in elsewhere.started:
        worker.process.wait(10)


def test_with_keys_a_callable_is_sent_and_a_revoked_key_is_a_lost_worker(elsewhere: Elsewhere, tmp_path: Path) -> None:
    folder = KeyFolder(tmp_path / "keys")
    for name in ("a", "b"):
        elsewhere.start(name, "--token", str(folder.new(name, datetime.now(UTC))))
    with make(
        lambda: gymnasium.make("CartPole-v1"),
        workers=None,
        lanes=2,
        bind=elsewhere.address,
        keys=str(folder.path),
        timeout=60.0,
    ) as env:
        env.reset(seed=1)
        assert env.step(ZEROS)[1].tolist() == [1.0] * 4
        folder.revoke("b", datetime.now(UTC))
        began = time.monotonic()
        while not (row := env.step(ZEROS))[4].get("worker_lost", ZEROS).any():
            time.sleep(0.05)
        assert time.monotonic() - began < 15.0, "long before the deadline"
        assert row[4]["worker_lost"].tolist() == [False, False, True, True]
        assert not env.step(ZEROS)[3].any()
    assert [worker.process.wait(10) for worker in elsewhere.started] == [0, 2]
    assert "revoked" in elsewhere.said()


def test_a_silent_worker_elsewhere_is_lost_long_before_the_deadline(elsewhere: Elsewhere) -> None:
    for name in ("a", "b"):
        elsewhere.start(name)
    with make(workers=None, lanes=2, bind=elsewhere.address, timeout=60.0) as env:
        env.reset(seed=1)
        assert env.step(ZEROS)[1].tolist() == [1.0] * 4
        elsewhere.started[1].pause()
        began = time.monotonic()
        row = env.step(ZEROS)
        assert 4.0 < time.monotonic() - began < 15.0
        assert row[4]["worker_lost"].tolist() == [False, False, True, True]
        assert not env.step(ZEROS)[3].any()
        elsewhere.started[1].go_on()
        assert env.reset(seed=1)[0].shape == (4, 4)


def test_a_slow_step_or_a_slow_caller_does_not_lose_a_worker(elsewhere: Elsewhere, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both take longer than the time after which a silent worker counts as lost."""
    monkeypatch.setattr(settings, "VectorEnvSettings", partial(settings.VectorEnvSettings, worker_timeout_s=2.0))
    elsewhere.start("a")
    with millrace.make_vec("tests.support.envs.toy:Slow-v0", 1, bind=elsewhere.address, seconds=3.0, timeout=60.0) as env:
        env.reset(seed=1)
        assert "worker_lost" not in env.step(np.zeros(1, np.int64))[4]
        time.sleep(3.0)
        assert env.call("has_wrapper_attr", "step") == (True,)
        assert "worker_lost" not in env.step(np.zeros(1, np.int64))[4]


def test_a_worker_without_a_token_is_refused(elsewhere: Elsewhere, tmp_path: Path) -> None:
    elsewhere.start("a")
    with pytest.raises(NoWorkers, match=r"0 joined \(\d+ were not let in.*start one: .* --token FILE"):
        make(workers=None, bind=elsewhere.address, keys=str(tmp_path / "keys"), timeout=5.0)


def test_keys_are_made_for_an_address_that_other_machines_can_reach(elsewhere: Elsewhere, tmp_path: Path) -> None:
    with pytest.raises(NoWorkers, match="--token FILE"):
        make(workers=None, bind="tcp://0.0.0.0:*", timeout=0.2)
    assert (tmp_path / ".config" / "millrace" / "keys" / "default.token").is_file()


def test_a_worker_that_runs_no_code_refuses_and_says_why(elsewhere: Elsewhere) -> None:
    elsewhere.start("a", "--no-code")
    with pytest.raises(
        UserFacingError, match=r"tests\.support\.envs\.toy:Countdown-v0 imports a module, which this worker does not do"
    ):
        make("tests.support.envs.toy:Countdown-v0", workers=None, bind=elsewhere.address, timeout=5.0).reset()
    assert elsewhere.started[0].process.wait(10) == 2


def test_a_worker_whose_step_hangs_is_ended_and_another_gets_its_lane(
    elsewhere: Elsewhere, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vector, "call_timeouts_of", lambda timeout_s: CallTimeouts(60.0, 3.0))
    elsewhere.start("h", "--processes", "2")
    with make(HANGS, workers=None, lanes=2, bind=elsewhere.address, after=1, once=str(tmp_path / "o"),
              timeout=60.0) as env:  # fmt: skip
        env.reset(seed=1)
        env.step(ZEROS)
        began = time.monotonic()
        truncated = env.step(ZEROS)[3]
        assert truncated.sum() == 2
        assert time.monotonic() - began < 30.0, "long before the deadline"
        assert env.step(ZEROS)[1][~truncated].tolist() == [1.0, 1.0]
    assert "a step of its environment took longer than 3 s (--step-timeout-s)" in elsewhere.said()
