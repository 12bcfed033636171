"""What an env copy returns and is given arrives with the same types, however many copies share its lane, or is refused."""

from __future__ import annotations

from typing import Any

import msgpack
import pytest

from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol import key_limit
from millrace.workers.vector_env import stepper
from tests.support.in_process.any_order import any_order
from tests.support.numbers.bit_equality import bit_equal

COPIES = 4
TABLE = {(n, n): n for n in range(8)}


@pytest.fixture
def only_one_such_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """A value may have one such table, but not two."""
    monkeypatch.setattr(key_limit, "MOST_KEYS_SQUARED", 100)


def exchanged(lanes: int) -> list[Any]:
    """The infos, results and attributes of the copies, each of which has a table with keys that aren't text."""
    settings = VectorEnvSettings("tests.support.envs.toy:Informs-v0", COPIES, lanes=lanes)
    with any_order(settings, lanes, shared=False) as (env, _):
        _, of_reset = env.reset(seed=1, options=[{"table": TABLE, "copy": n} for n in range(COPIES)])
        _, of_all = env.reset(seed=1, options={"table": TABLE})
        env.set_attr("level", [TABLE] * COPIES)
        return [of_reset, of_all, env.get_attr("level")]


@pytest.mark.usefixtures("only_one_such_table")
@pytest.mark.parametrize("lanes", [1, 2])
def test_values_do_not_depend_on_the_lanes(lanes: int) -> None:
    alone = exchanged(COPIES)
    assert list(alone[2]) == [TABLE] * COPIES
    assert bit_equal(alone, exchanged(lanes))


def test_infos_that_cannot_be_read_are_logged_escaped(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Numpy's error quotes the dtype as it is. One line says that the worker was refused, the other what that costs."""
    array = msgpack.packb(["M8[\x1b]0;forged\x07]", [0], b""])
    infos = msgpack.packb([[0, {"a": msgpack.ExtType(3, array)}]])
    with any_order(VectorEnvSettings("tests.support.envs.toy:Informs-v0", 1, lanes=1), 2, shared=False) as (env, _):
        env.reset(seed=1)
        monkeypatch.setattr(stepper, "pack_infos", lambda _: infos)
        env.step(env.action_space.sample())
        monkeypatch.undo()
        env.step(env.action_space.sample())
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 2
    for line in lines:
        assert r"infos cannot be read: not a plain value: " in line
        assert r"[\x1b]0;forged\x07]" in line
