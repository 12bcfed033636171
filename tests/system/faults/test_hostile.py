"""A learner over TCP with hostile peers: its weights do not depend on their messages, nor on when a worker dies."""

from __future__ import annotations

import time
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import zmq

from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import Inquire, Status
from millrace.protocol.wire.codec import decode_to_observer, encode
from millrace.workers.copies.env_copies import copy_seed
from tests.support.conversation.hostile_messages import hostile, real
from tests.system.stage.processes import START_S, Learner, Stage, free_port
from tests.system.stage.run_folders import policy_of
from tests.system.stage.runs import accounted

MESSAGES, STRANGERS = 100_000, 5
GROWTH_MB = 20  # growth in the second half: by then the heap has the memory for messages that wait to be read


def result(learner: Learner) -> tuple[bytes, dict[str, Any], list[dict[str, Any]]]:
    """Wait for the end of the run. Returns the policy, the summary and the rows of metrics."""
    assert learner.ends(START_S) == 0, learner.said()[-5_000:]
    return policy_of(learner.folder), learner.summary(), learner.rows()


def answered(stranger: zmq.Socket[bytes]) -> None:
    """Wait until the learner has read everything that this stranger sent, so that no data is on its way."""
    stranger.send_multipart([bytes(frame) for frame in encode(Inquire())])
    deadline_s = time.monotonic() + START_S
    while True:
        assert stranger.poll(max(0, int(1000 * (deadline_s - time.monotonic())))), "a stranger's question was not answered"
        with suppress(BadMessage):  # the learner's answers to its invalid messages
            if isinstance(decode_to_observer(stranger.recv_multipart()), Status):
                return


def pester(learner: Learner, address: str) -> float:
    """Send hostile messages under several names while the learner learns. Returns its growth in MB."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    strangers = []
    for n in range(STRANGERS):
        stranger = context.socket(zmq.DEALER)
        stranger.routing_id = f"stranger{n}".encode()
        stranger.linger, stranger.sndtimeo = 0, 30_000
        stranger.connect(address)
        strangers.append(stranger)
    sizes = []
    try:
        for number, frames in enumerate(islice(hostile(3, real(7)), MESSAGES)):
            stranger = strangers[number % STRANGERS]
            while stranger.poll(0):  # one that does not read its answers may be cut off, which is not what is tested here
                stranger.recv_multipart()
            stranger.send_multipart(frames)
            if number % 1_000 == 999:
                for stranger in strangers:
                    answered(stranger)
                sizes.append(learner.memory_mb())
    finally:
        for stranger in strangers:
            stranger.close(0)
        context.term()
    return sizes[-1] - sizes[len(sizes) // 2]


@pytest.mark.soak
def test_invalid_messages_of_strangers_do_not_change_the_weights(tmp_path: Path) -> None:
    settings = {"env-kwargs": "", "rollout-steps": 32, "batch-size": 256, "n-epochs": 4, "steps": 80_000, "seed": 5}

    def learn(name: str, loud: bool) -> tuple[bytes, dict[str, Any], float]:
        with closing(Stage(tmp_path / name)) as stage:
            address = f"tcp://127.0.0.1:{free_port()}"
            learner = stage.learner(address, settings, env="CartPole-v1")
            stage.worker(address, "w0")
            learner.trains(1)
            grew_mb = pester(learner, address) if loud else 0.0
            policy, summary, _ = result(learner)
            return policy, summary, grew_mb

    expected, _, _ = learn("quiet", loud=False)
    found, summary, grew_mb = learn("loud", loud=True)
    assert found == expected
    assert grew_mb < GROWTH_MB
    ledger = accounted(summary, rows=32 * 2)
    assert ledger["messages_bad"] > MESSAGES / 3  # the rest used a session of another peer


@pytest.mark.soak
def test_two_runs_in_which_the_same_ticket_kills_its_worker_give_the_same_weights(tmp_path: Path) -> None:
    """Until that ticket, they are equal to the run without a death. After it, only the incarnation of the lane differs."""
    steps, seed, deadly_update = 16, 2, 3  # after 32 rows, in the middle of an episode, which takes 6
    doomed = copy_seed(seed, lane=1, start=0, copy=1)
    after = ((deadly_update - 1) * steps + steps // 2) * 5 // 6  # env steps: every sixth row only resets

    def learn(name: str, only_seed: int) -> tuple[bytes, dict[str, Any], list[dict[str, Any]]]:
        settings = {
            "envs": 4,
            "lanes": 2,
            "rollout-steps": steps,
            "steps": 800,
            "seed": seed,
            "min-workers": 2,
            "env-kwargs": f"after {after} only_seed {only_seed}",
            "lost-lanes": "restart",  # a copy that is brought back has the same seed, so it would die again
        }
        with closing(Stage(tmp_path / name)) as stage:
            address = f"tcp://127.0.0.1:{free_port()}"
            learner = stage.learner(address, settings, env="tests.support.envs.toy:Dies-v0")
            for number in range(2):
                stage.worker(address, f"w{number}")
            return result(learner)

    undisturbed, first, second = learn("undisturbed", -1), learn("first", doomed), learn("second", doomed)
    assert first[1]["ledger"]["lost"] > 0 == undisturbed[1]["ledger"]["lost"]
    assert first[0] == second[0] != undisturbed[0]

    def learned(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [{name: value for name, value in row.items() if name.startswith("train/")} for row in rows]

    assert learned(first[2]) == learned(second[2])
    before, after_it = learned(undisturbed[2]), learned(first[2])
    assert before[: deadly_update - 1] == after_it[: deadly_update - 1]
    assert before[deadly_update - 1] != after_it[deadly_update - 1]
