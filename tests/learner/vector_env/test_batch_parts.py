"""The pure parts of the vector environment: the layout of a batch, infos, lost lanes and the record of settings."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.calls import _descriptions
from millrace.learner.vector_env.infos import MOST_WARNED, InfoReader, unpack_infos
from millrace.learner.vector_env.lost_lanes import LostLanes, replacement_seeds
from millrace.learner.vector_env.sent_lanes import Ready
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.envs.description import describe_env
from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import Described, Goodbye, Returned, ToLearner
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.plain_values import pack, pack_each
from tests.support.conversation.example_messages import example


def test_lanes_have_consecutive_rows() -> None:
    layout = BatchLayout((3, 1, 2))
    assert layout.count == 6
    assert [layout.lane_of(copy) for copy in range(6)] == [0, 0, 0, 1, 2, 2]
    assert [list(layout.copies(lane)) for lane in layout.lanes] == [[0, 1, 2], [3], [4, 5]]
    assert layout.by_lane([0, 2, 5]) == {0: [0, 2], 2: [1]}
    for wrong in (-1, 6):
        with pytest.raises(IndexError, match=f"copy: expected 0 to 5, got {wrong}"):
            layout.lane_of(wrong)


def test_infos_get_the_number_of_their_env_copy() -> None:
    assert unpack_infos(pack([(0, {"a": 1}), [1, {}], [2, {"b": 1}]]), range(4, 6)) == {4: {"a": 1}, 5: {}}


def read(reader: InfoReader, infos: Sequence[tuple[int, Any]]) -> None:
    reader.by_row(Ready({0: pack_each(infos, use_repr=True)}, {}))


def test_infos_that_arrive_as_their_repr_are_reported_once_and_few_of_them(caplog: pytest.LogCaptureFixture) -> None:
    """The keys come from a worker: it must not fill the log or the memory with them, or forge a line."""
    reader = InfoReader(BatchLayout([2]), lambda lane, why: pytest.fail(why))
    for _ in range(2):
        read(reader, [(1, {"a\nWARNING forged": object()})])
    assert [record.getMessage() for record in caplog.records] == [
        r"info a\nWARNING forged of row 1 is not plain data: it arrives as its repr, a string"
    ]
    for step in range(3):
        read(reader, [(0, {f"{step}.{n}": object() for n in range(100)})])
    assert len(caplog.records) == MOST_WARNED + 1
    assert caplog.records[-1].getMessage() == "more infos are not plain data; the log doesn't name them"
    assert len(reader._warned) == MOST_WARNED


@pytest.mark.parametrize("value", [7, [7], [[0]], [[0, 1, 2]], [[0, "text"]], [[0.0, {}]], [[True, {}]]])
def test_what_is_not_infos_is_refused(value: object) -> None:
    with pytest.raises(BadMessage):
        unpack_infos(pack(value), range(2))


def returned(results: bytes, error: str = "") -> Returned:
    return example(Returned, session=1, ticket=2, results=np.frombuffer(results, np.uint8), error=error)


def frames(message: ToLearner) -> list[bytes]:
    return [bytes(frame) for frame in encode(message)]


def test_copies_are_what_their_worker_describes_or_unknown_where_it_cannot() -> None:
    env = gymnasium.make("CartPole-v1")
    found = _descriptions(returned(pack([frames(Described(1, 1, describe_env(env)))] * 2)), 2)
    assert [copy and (copy.observation_space, copy.action_space) for copy in found] == [
        (env.observation_space, env.action_space)
    ] * 2
    assert _descriptions(returned(b"", "no attributes"), 2) == [None, None]


@pytest.mark.parametrize("sent", [7, "frames", [], [7], [b"\xc1"], frames(Goodbye(1, "left", ()))])
def test_what_describes_no_copy_is_refused(sent: object) -> None:
    with pytest.raises(BadMessage):
        _descriptions(returned(pack([sent])), 1)


def test_each_loss_is_reported_once_and_then_the_lane_awaits_a_reset() -> None:
    lanes = LostLanes()
    lanes.add({0: "worker w0 left", 1: "worker w1 was killed"})
    assert lanes.report([0, 1]) == {0: "worker w0 left", 1: "worker w1 was killed"}
    assert not lanes.unreported
    assert lanes.awaiting_reset == {0, 1}
    lanes.answered({1})
    assert lanes.awaiting_reset == {0}


def test_a_lane_that_was_lost_after_it_answered_is_reported_in_the_next_step() -> None:
    lanes = LostLanes()
    lanes.add({1: "worker w1 was killed"})
    assert lanes.report([]) == {}
    assert lanes.unreported == {1: "worker w1 was killed"}
    assert lanes.report([1]) == {1: "worker w1 was killed"}


def test_replacement_seeds_differ_from_the_old_ones_and_are_reproducible() -> None:
    seeds = replacement_seeds((1, None, 2), incarnation=1)
    assert seeds[1] is None
    assert len({1, 2, seeds[0], seeds[2]}) == 4
    assert seeds == replacement_seeds((1, None, 2), incarnation=1)
    assert seeds != replacement_seeds((1, None, 2), incarnation=2)


def test_the_record_of_settings_has_the_defaults_of_make_vec() -> None:
    public = {name: parameter.default for name, parameter in inspect.signature(millrace.make_vec).parameters.items()}
    record = {field.name: field.default for field in dataclasses.fields(VectorEnvSettings)}
    assert record.pop("timeout_s") == public["timeout"]
    of_runs = {"single_lanes", "evaluates", "worker_timeout_s", "call_timeouts"}
    for name in record.keys() - {"env", "listen", "kwargs"} - of_runs:
        assert record[name] == public[name], name
