"""Learner processes of a run with shards, as real processes: what each says and how it ends, whatever happens to another."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from millrace.learner.run_folder.metrics_log import read_rows
from tests.system.stage.processes import free_port, wait_for

WITHIN_S = 120.0
RUNS = "runs"
CODE = "tests.support.users_code"
FLAGS = (
    *("--shards", "2", "--lanes", "2", "--envs", "4", "--workers", "1", "--rollout-steps", "64"),
    *("--torch-threads", "1", "--eval-episodes", "2", "--checkpoint-every-s", "0"),
)
OTHER_VERSIONS = """
import sys
from millrace.learner.shards import roles
roles.versions = lambda: {"torch": "0.0.1"}
from millrace.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
FAILS_BETWEEN_UPDATES = """
import sys
from millrace.learner.between_updates.audience import Audience
def fails(*given): raise ValueError("no callback today")
Audience.updated = fails
from millrace.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
CONNECTED = """
import sys
from torch import distributed
distributed.init_process_group("gloo")
from millrace.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


class Ranks(list[subprocess.Popen[str]]):
    """The processes of a run, by rank."""

    def end(self) -> list[tuple[int, str]]:
        """The exit code of each, and what it said."""
        ended = [each.communicate(timeout=WITHIN_S)[0] for each in self]
        return [(each.returncode, said) for each, said in zip(self, ended, strict=True)]


@contextmanager
def ranks(
    folder: Path,
    count: int,
    *flags: str,
    env: str = "CartPole-v1",
    steps: int = 4096,
    of_rank: Mapping[int, Sequence[str]] = {},
    program: Mapping[int, Sequence[str]] = {},
) -> Iterator[Ranks]:
    """Start a run with this number of processes. `of_rank`: more flags of a rank; `program`: what it runs."""
    started = Ranks()
    port = free_port()
    own = {"TMPDIR": str(folder / "of_ranks")}  # a learner that is killed before its workers start leaves a folder there
    (folder / "of_ranks").mkdir(exist_ok=True)
    try:
        for rank in range(count):
            place = {"RANK": rank, "WORLD_SIZE": count, "MASTER_ADDR": "localhost", "MASTER_PORT": port}
            command = [sys.executable, *program.get(rank, ("-m", "millrace")), "train", env, *FLAGS, "--steps", str(steps)]
            started.append(
                subprocess.Popen(
                    [*command, "--run-dir", str(folder / RUNS), *flags, *of_rank.get(rank, ())],
                    env=os.environ | own | {name: str(value) for name, value in place.items()},
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            )
        yield started
    finally:
        for each in started:
            each.kill()
            each.communicate()


def run_in(folder: Path) -> Path:
    """The newest run; one that was killed before its first checkpoint is not continued."""
    return max((folder / RUNS).iterdir())


def updates(folder: Path) -> int:
    """How many updates the run in this folder has made."""
    return sum(len(read_rows(file)) for file in folder.glob(f"{RUNS}/*/metrics.jsonl"))


def policy(folder: Path) -> bytes:
    return (run_in(folder) / "policy.safetensors").read_bytes()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The policy of the run with one process."""
    folder = tmp_path_factory.mktemp("one")
    with ranks(folder, 1) as started:
        ((code, said),) = started.end()
    assert code == 0, said
    return policy(folder)


def test_settings_of_rank_0_count_and_the_policy_is_that_of_one_process(tmp_path: Path, undisturbed: bytes) -> None:
    others = ("--seed", "7", "--learning-rate", "0.1", "--shards", "4", "--lanes", "4")
    with ranks(tmp_path, 2, of_rank={1: others}) as started:
        (code, said), (other_code, other_said) = started.end()
    assert (code, other_code) == (0, 0), said + other_said
    assert "2 shards, 1 for each of 2 learner processes" in said
    assert f"rank 1 of 2 takes part in the updates of run {run_in(tmp_path)}" in other_said
    assert "Exception raised from" not in other_said  # PyTorch's traces of tries to connect
    assert policy(tmp_path) == undisturbed


def test_the_policy_may_act_in_rank_0(tmp_path: Path, undisturbed: bytes) -> None:
    with ranks(tmp_path, 2, "--inference", "learner") as started:
        (code, said), (_, other_said) = started.end()
    assert code == 0, said + other_said
    assert policy(tmp_path) == undisturbed


@pytest.mark.soak
@pytest.mark.parametrize(
    ("env", "flags"), [(f"{CODE}.seat_envs:RandomCrowd", ()), (f"{CODE}.mask_envs:Mixed-v0", ("--action-masks", "info"))]
)
def test_seats_and_masks_are_divided_among_processes(tmp_path: Path, env: str, flags: Sequence[str]) -> None:
    policies = set()
    for count in (1, 2):
        folder = tmp_path / str(count)
        folder.mkdir()
        with ranks(folder, count, *flags, env=env) as started:
            for code, said in started.end():
                assert code == 0, said
        policies.add(policy(folder))
    assert len(policies) == 1


def test_a_rank_that_cannot_see_the_folder_learns_that_the_run_was_finished(tmp_path: Path) -> None:
    with ranks(tmp_path, 1, steps=256) as started:
        ((code, said),) = started.end()
    assert code == 0, said
    elsewhere = ("--run-dir", str(tmp_path / "elsewhere"))
    with ranks(tmp_path, 2, "--resume", "auto", steps=256, of_rank={1: elsewhere}) as started:
        (code, said), (other_code, other_said) = started.end()
    assert (code, other_code) == (0, 0), said + other_said
    assert "rank 1: the run was finished before" in other_said


def test_processes_that_are_connected_already_use_their_group(tmp_path: Path, undisturbed: bytes) -> None:
    with ranks(tmp_path, 2, program=dict.fromkeys((0, 1), ("-c", CONNECTED))) as started:
        (code, said), (other_code, other_said) = started.end()
    assert (code, other_code) == (0, 0), said + other_said
    assert policy(tmp_path) == undisturbed


def test_a_killed_rank_ends_all_and_a_run_that_is_resumed_with_fewer_is_the_same(tmp_path: Path, undisturbed: bytes) -> None:
    with ranks(tmp_path, 2) as started:
        wait_for(lambda: updates(tmp_path) >= 3, WITHIN_S, "three updates")
        started[1].kill()
        (code, said), _ = started.end()
    assert code == 75
    assert "learner: another learner process is lost, or too slow (" in said
    assert "; start all of them again, with --resume auto" in said
    with ranks(tmp_path, 1, "--resume", "auto") as started:
        ((code, said),) = started.end()
    assert code == 0, said
    assert policy(tmp_path) == undisturbed


def test_a_rank_that_hangs_ends_all_after_the_timeout(tmp_path: Path) -> None:
    with ranks(tmp_path, 2, "--shard-timeout-s", "5", steps=1_000_000) as started:
        wait_for(lambda: updates(tmp_path) >= 1, WITHIN_S, "an update")
        started[1].send_signal(signal.SIGSTOP)
        assert started[0].wait(WITHIN_S) == 75
        started[1].send_signal(signal.SIGCONT)
        assert [code for code, _ in started.end()] == [75, 75]


def test_an_interrupted_rank_0_ends_all_and_saves(tmp_path: Path) -> None:
    """A launcher sends the signal to every process."""
    with ranks(tmp_path, 2, steps=1_000_000) as started:
        wait_for(lambda: updates(tmp_path) >= 1, WITHIN_S, "an update")
        for each in started:
            each.send_signal(signal.SIGTERM)
        (code, said), (other_code, other_said) = started.end()
    assert (code, other_code) == (130, 0), said + other_said
    assert "millrace: interrupted; continue with: " in said, said
    assert "rank 1: rank 0 has ended" in other_said


def test_an_error_of_rank_0_between_updates_ends_all_with_it(tmp_path: Path) -> None:
    """Otherwise a launcher that starts each process again by itself would start rank 0 alone."""
    with ranks(tmp_path, 2, program={0: ("-c", FAILS_BETWEEN_UPDATES)}) as started:
        (code, said), (other_code, other_said) = started.end()
    assert (code, other_code) == (1, 1), said + other_said
    assert "rank 1: rank 0 has ended: no callback today" in other_said


def test_a_rank_with_other_packages_is_refused_by_all(tmp_path: Path) -> None:
    with ranks(tmp_path, 2, program={1: ("-c", OTHER_VERSIONS)}) as started:
        ended = started.end()
    for code, said in ended:
        assert code == 2
        assert "learner: rank 1: python: expected " in said
        assert ", as rank 0 has, got none; install the same in both" in said
    assert not (tmp_path / RUNS).exists()


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10))
def test_a_run_whose_processes_are_killed_at_random_is_the_same(tmp_path: Path, undisturbed: bytes, seed: int) -> None:
    """Each start has one or two processes, until one of them is killed, is told to end, or hangs."""
    generator = random.Random(seed)
    ends: list[tuple[int, signal.Signals, list[int]]] = []
    while True:
        with ranks(tmp_path, generator.choice([1, 2, 2]), "--resume", "auto", "--shard-timeout-s", "5") as started:
            hit = generator.choice(started)
            number = generator.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
            with suppress(subprocess.TimeoutExpired):  # in the end it is left alone
                started[0].wait(generator.uniform(2, 9) if len(ends) < 8 else WITHIN_S)
            hit.send_signal(number)
            others = [each for each in started if each is not hit]
            if number == signal.SIGSTOP:
                with suppress(subprocess.TimeoutExpired):  # they may not have met yet
                    _ = [each.wait(10) for each in others]
                hit.kill()
            for each in others:
                each.send_signal(signal.SIGTERM)  # as torchrun does
            ends.append((started.index(hit), number, []))
            ends[-1][2].extend(code for code, _ in started.end())
        codes = ends[-1][2]
        assert {*codes} <= {0, 75, 130, -signal.SIGKILL}, ends
        if codes[0] == 0:
            break
    assert policy(tmp_path) == undisturbed, ends
