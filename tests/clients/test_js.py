"""The JavaScript client: training through kills and restarts, tokens, hostile messages."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from tests.system.stage.processes import START_S, Learner, Running, Stage, free_port

pytestmark = pytest.mark.clients
MESSAGES = 100_000  # hostile ones


def learner(stage: Stage, address: str, *flags: str, steps: int = 4_000) -> Learner:
    """`millrace learner` at this address, which acts for its workers."""
    command = [sys.executable, "-m", "millrace", "learner", "CartPole-v1", "--bind", address, "--run-dir", str(stage.runs)]
    settings = f"--preset none --inference learner --steps {steps} --eval-episodes 2 --worker-timeout-s 3".split()
    made = Learner([*command, *settings, *flags], stage.tmp_path / "learner.log", stage.runs)
    stage.started.append(made)
    return made


def cartpole(stage: Stage, js: Path, address: str, name: str, *flags: str) -> Running:
    return stage.start(["node", str(js / "examples" / "cartpole.js"), address, "--name", name, *flags], name)


def test_a_learner_trains_with_clients_that_are_killed_and_started_again(stage: Stage, js: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, "--lanes", "2", steps=30_000)
    clients = [cartpole(stage, js, address, name) for name in ("first", "second")]
    runs.trains(3)
    clients[0].kill()
    runs.hears("first", START_S)
    again = cartpole(stage, js, address, "first")
    runs.trains(3)
    assert runs.ends(120) == 0, runs.said()
    assert [client.ends() for client in (again, clients[1])] == [0, 0]
    assert "left: " in again.said()
    ledger = runs.ledger()
    assert ledger["issued"] == ledger["used"] + ledger["lost"] + ledger["outstanding"]
    assert runs.rows()[-1]["rollout/ep_rew_mean"] > 40, "a random policy gets 22"


def test_it_learns_of_a_token_and_of_its_end(stage: Stage, js: Path) -> None:
    address, keys = f"tcp://127.0.0.1:{free_port()}", stage.tmp_path / "keys"

    def manage(*words: str) -> None:
        subprocess.run([sys.executable, "-m", "millrace", "keys", *words, "--keys", str(keys)], check=True, timeout=60)

    manage("new", "lab")
    runs = learner(stage, address, "--keys", str(keys), steps=10_000_000)
    bare = cartpole(stage, js, address, "bare")
    lab = cartpole(stage, js, address, "lab", "--token", str(keys / "lab.token"))
    runs.trains(1)
    copy = stage.tmp_path / "copy.token"
    copy.touch(mode=0o600)
    copy.write_text((keys / "lab.token").read_text())
    manage("revoke", "lab")
    assert lab.ends() == 2
    assert "revoked" in lab.said()
    again = cartpole(stage, js, address, "again", "--token", str(copy))
    assert again.ends() == 2
    assert "refused this client's key" in again.said()
    assert "joined" not in bare.said()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("millrace1.short", "token: expected 101 characters, got 15; copy it again"),
        ("millrace1." + "A" * 91, "token: a character of it is wrong; copy it again"),
        ("something", "token: expected one line that begins with millrace1., got something else"),
    ],
)
def test_a_damaged_token_is_named_in_one_line(stage: Stage, js: Path, text: str, said: str) -> None:
    token = stage.tmp_path / "damaged.token"
    token.write_text(text + "\n")
    client = cartpole(stage, js, "tcp://127.0.0.1:9", "damaged", "--token", str(token))
    assert client.ends() == 2
    assert client.said().strip() == f"damaged: {said}"


# ---------------------------------------------------------------- hostile messages


def mutated(chance: random.Random, message: list[bytes]) -> list[bytes]:
    """The message with a few bytes changed, left out or repeated, or with a frame more or less."""
    frames = [bytearray(frame) for frame in message]
    for _ in range(chance.randint(1, 3)):
        frame = chance.choice(frames)
        at = chance.randrange(len(frame) + 1)
        match chance.randrange(5):
            case 0 if frame:
                frame[at % len(frame)] = chance.randrange(256)
            case 1:
                del frame[at : at + chance.randint(1, 4)]
            case 2:
                frame[at:at] = bytes(chance.randrange(256) for _ in range(chance.randint(1, 4)))
            case 3:
                frames.append(bytearray(chance.randbytes(chance.randrange(9))))
            case _ if len(frames) > 1:
                frames.pop()
    return [bytes(frame) for frame in frames]


class Router:
    """A learner's socket, and what the client says."""

    def __init__(self, address: str) -> None:
        self.socket: Any = zmq.Context.instance().socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.SNDHWM, 0)
        self.socket.bind(address)

    def says(self, head: Any, *frames: bytes) -> None:
        self.socket.send_multipart([b"target", msgpack.packb(head), *frames])

    def hears(self, kind: str, where: Any = lambda head: True, within_s: float = 30.0) -> Any:
        """The next message of this kind. The others are dropped."""
        deadline_s = time.monotonic() + within_s
        while self.socket.poll(max(1, int(1000 * (deadline_s - time.monotonic())))):
            head = msgpack.unpackb(self.socket.recv_multipart()[1])
            if kind == (head["type"] if isinstance(head, dict) else head[0]) and where(head):
                return head
            assert time.monotonic() < deadline_s, f"no {kind}"
        raise AssertionError(f"no {kind}")


@pytest.fixture
def router(request: pytest.FixtureRequest) -> Iterator[tuple[Router, str]]:
    address = f"tcp://127.0.0.1:{free_port()}"
    made = Router(address)
    yield made, address
    made.socket.close()


def test_hostile_messages_do_not_end_it(stage: Stage, js: Path, router: tuple[Router, str]) -> None:
    """Mutations of orders and of what travels beside them. Afterwards it answers an order as before."""
    learns, address = router
    client = cartpole(stage, js, address, "target")
    attempt = learns.hears("Hello")["attempt"]
    leaf = {"path": "", "kind": "box", "shape": [4], "dtype": "float32", "sizes": [], "start": []}
    run = {
        "type": "StepSpec", "envs": [{"id": "CartPole-v1"}], "copies": [0, 0], "lanes": [2], "observation": [leaf],
        "action": [leaf], "heartbeat_s": 0.5,
    }  # fmt: skip
    learns.says(["Welcome", 7, attempt, run])
    learns.hears("Heartbeat")
    actions, nothing = np.zeros(2, "<i8").tobytes(), b"\xc0"
    heads: list[tuple[Any, ...]] = [
        (["Reset", 7, 1, 0, 0, [0, 1], [5, None], ["|u1", [1], 1]], nothing),
        (["Step", 7, 2, 0, 0, [["<i8", [2], 1]]], actions),
        (["Call", 7, 3, 0, 0, [0], "name", False, ["|u1", [1], 1]], nothing),
        (["HeartbeatReply", 7, 1, [[0, 0, 0, []]]],),
        (["Release", 7, [[0, 0]]],),
        (["Weights", 3, ["<f4", [2], 1], ["<f4", [0], 2], None], bytes(8), b""),
        (["Welcome", 8, 1, run],),  # of another attempt, and no mutation makes it this one
    ]
    messages = [[msgpack.packb(head), *frames] for head, *frames in heads]
    chance = random.Random(1)
    for _ in range(MESSAGES):
        learns.socket.send_multipart([b"target", *mutated(chance, chance.choice(messages))])
        while learns.socket.poll(0):
            learns.socket.recv_multipart()
    life = 2**52
    learns.says(["Reset", 7, 2**52, 0, life, [0, 1], [5, 6], ["|u1", [1], 1]], nothing)
    assert learns.hears("Stepped", lambda head: head[4] == life, 120.0)[2] == 2**52
    assert client.alive()
