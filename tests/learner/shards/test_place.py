"""Which learner process this one is, and which shards it has."""

from __future__ import annotations

import os
from ipaddress import ip_address

import numpy as np
import pytest
from torch import distributed

from millrace.learner.config.layers import resolve
from millrace.learner.shards.division import Division, pairwise_sum
from millrace.learner.shards.learners import Timeouts, connected, listening
from millrace.learner.shards.place import ALONE, INTERFACES, LOOPBACK, Place, check_loopback, trains_alone
from millrace.protocol.errors import UsageError

VARIABLES = {"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": "29500"}


def test_a_place_is_what_the_launcher_says() -> None:
    assert Place.of(VARIABLES) == Place(1, 2, "localhost", 29500)
    assert Place.of({}) == Place.of({"WORLD_SIZE": "1", "RANK": "0"}) == ALONE


def test_several_processes_of_a_run_without_shards_are_warned_of() -> None:
    assert trains_alone({}) == trains_alone({"WORLD_SIZE": "1"}) == ""
    assert trains_alone(VARIABLES).startswith("WORLD_SIZE is 2, but shards is 1: each process trains a run of its own; ")


@pytest.mark.parametrize("name", ["RANK", "MASTER_ADDR", "MASTER_PORT"])
def test_incomplete_variables_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match=rf"^shards: expected RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT.*got '{name}'$"):
        Place.of({key: value for key, value in VARIABLES.items() if key != name})


def test_a_rank_beyond_the_others_is_refused() -> None:
    with pytest.raises(UsageError, match=r"^shards: expected RANK from 0 to 1, got 2$"):
        Place.of(VARIABLES | {"RANK": "2"})


def test_shards_that_cannot_be_divided_are_refused() -> None:
    with pytest.raises(UsageError, match=r"^shards 3: expected a multiple of 2, the number of learner processes \(W"):
        Place.of(VARIABLES).division(3)
    with pytest.raises(UsageError, match=r"^shards: expected a divisor of lanes 4, got 3$"):
        resolve("CartPole-v1", shards=3, lanes=4, envs=8)
    with pytest.raises(UsageError, match=r"^shards 2: dqn learns in one process; expected ppo, a2c, impala or reinforce$"):
        resolve("CartPole-v1", algo="dqn", shards=2)


def test_a_network_is_used_only_if_a_flag_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GLOO_SOCKET_IFNAME", raising=False)
    elsewhere = Place.of(VARIABLES | {"MASTER_ADDR": "10.0.0.1"})
    with pytest.raises(UsageError, match=r"^MASTER_ADDR 10\.0\.0\.1: expected localhost, because .* add --insecure-shards$"):
        check_loopback(elsewhere, insecure=False)
    check_loopback(elsewhere, insecure=True)
    assert "GLOO_SOCKET_IFNAME" not in os.environ


def test_a_network_that_the_cluster_names_is_not_used_without_the_flag(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in INTERFACES:
        monkeypatch.setenv(name, "eth0")
    check_loopback(Place.of(VARIABLES), insecure=True)
    assert {os.environ[name] for name in INTERFACES} == {"eth0"}
    check_loopback(Place.of(VARIABLES), insecure=False)
    assert {os.environ[name] for name in INTERFACES} <= set(LOOPBACK)


def test_the_store_of_this_machine_listens_on_loopback() -> None:
    with listening(Place(0, 2, "localhost", 0)) as store:
        host, port, *_ = store.getsockname()
        assert ip_address(host).is_loopback
        taken = Place(0, 2, "localhost", port)
        with pytest.raises(UsageError, match=rf"^MASTER_PORT {port}: expected a free port .*; set another one"):
            listening(taken)
    with listening(Place(0, 2, "10.0.0.1", 0)) as store:
        assert ip_address(store.getsockname()[0]).is_unspecified


def test_the_group_of_a_program_that_has_connected_the_processes_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is neither made nor destroyed."""
    monkeypatch.setattr(distributed, "is_initialized", lambda: True)
    for name in ("init_process_group", "destroy_process_group"):
        monkeypatch.delattr(distributed, name)
    with connected(Place.of(VARIABLES), 2, "cpu", Timeouts(0.0, 0.0), lambda: None) as learners:
        assert learners.division == Division(2, 2, 1)


def test_every_column_belongs_to_one_shard_and_every_shard_to_one_process() -> None:
    lane = np.repeat(np.arange(12), 3)
    for processes in (1, 2, 4):
        divisions = [Division(4, processes, rank) for rank in range(processes)]
        assert [shard for each in divisions for shard in each.own] == [0, 1, 2, 3]
        columns = np.concatenate([each.columns_of_process(lane, each.rank) for each in divisions])
        assert sorted(columns) == list(range(36))
    assert set(lane[Division(4, 1, 0).columns(lane)[1]]) == {1, 5, 9}


def test_sums_are_a_tree_of_pairs() -> None:
    class Text(str):
        def __add__(self, other: str, /) -> Text:
            return Text(f"({self}+{other})")

    assert pairwise_sum([Text(each) for each in "abcde"]) == "(((a+b)+(c+d))+e)"
    assert pairwise_sum([Text("a")]) == "a"
