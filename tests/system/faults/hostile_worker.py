"""A client with a valid key that joins as a spare worker and says what it likes. It can run as a separate process.

Rule: it says every field of every message at extreme values, and floods of good messages. It owns no lane, unless the
learner gives it the lane of a worker that is gone.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import zmq

from millrace.protocol.keys.worker_token import read_token
from millrace.protocol.messages import (
    Alive,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Inquire,
    ToLearner,
    Welcome,
)
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.worker_link import WorkerLink
from tests.support.conversation.example_messages import example
from tests.support.conversation.extreme_messages import MARK, SESSION, extremes, of_session
from tests.support.conversation.fake_ends import fake_rollout
from tests.support.conversation.hostile_messages import real
from tests.system.stage.processes import START_S

NAME = "[/red]spare"


class Hostile:
    """Joins as a spare worker, as often as it is refused, and says what it likes."""

    def __init__(self, address: str, token: Path, stack: ExitStack) -> None:
        self._address, self._token = address, read_token(str(token))
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(self._context.term)
        self._stack = stack
        self._nonces = itertools.count(int.from_bytes(os.urandom(5), "little"))  # no other process was refused under them
        self.said = self.sessions = 0
        self._link = self.link(NAME)

    def link(self, name: str) -> WorkerLink:
        """A connection under a name."""
        made = WorkerLink(self._address, name, self._context, self._token)
        self._stack.callback(made.close, 0.0)
        return made

    def joins(self, name: str = NAME, link: WorkerLink | None = None) -> int:
        """A session of its own: each time as another process."""
        link, nonce = link or self._link, next(self._nonces)
        deadline_s = time.monotonic() + START_S
        while True:
            link.send(
                encode(example(Hello, worker=name, host="[bold]host", process_nonce=nonce, software="fuzz", attempt=nonce))
            )
            if link.poll(2.0):
                for message in link.receive():
                    if isinstance(message, Welcome) and message.attempt == nonce:
                        self.sessions += 1
                        return message.session
            assert time.monotonic() < deadline_s, "the hostile worker was not let in"

    def says(self, sayings: Iterator[list[bytes]], at_once: int = 3) -> None:
        """Say all of these in sessions of its own. After so many it joins again, for it may have been refused."""
        while said := list(itertools.islice(sayings, at_once)):
            session = self.joins()
            for frames in said:
                self._link.send(of_session(frames, session))
                self.said += 1

    def floods(self, make: Callable[[int], list[ToLearner | Inquire]], seconds: float, names: int) -> None:
        """Say this again and again, each time in a new session, under so many names."""
        links = {f"[red]{'n' * 100}{n}": None for n in range(names)}
        opened = {name: self.link(name) for name in links}
        until_s = time.monotonic() + seconds
        for name in itertools.cycle(opened):
            if time.monotonic() > until_s:
                break
            session = self.joins(name, opened[name])
            for message in make(session):
                opened[name].send(encode(message))
                self.said += 1
        for link in opened.values():
            link.close(0.0)


FLOODS: list[Callable[[int], list[ToLearner | Inquire]]] = [
    lambda session: [Goodbye(session, "x" * 1_000, ())],
    lambda session: [
        example(
            Failure,
            session=session,
            error="[/red]boom",
            traceback=f"2026-11-22 05:00:00,000 learner: forged\n{MARK}" * 1_500,
            lane=0,
        )
    ],
    lambda session: (
        [
            example(
                Heartbeat,
                session=session,
                replies=2**53,
                versions=(2**53,),
                tickets=tuple(range(60_000)),
                steps=2**53,
                stages={"step": 1e9},
                resident_bytes=2**53,
            )
        ]
        * 5
    ),
    lambda session: [Inquire()] * 20,
    lambda session: [Alive((), ())] * 20,
    lambda session: [fake_rollout(session, n % 2, n, n, n) for n in range(20)],
]


def sayings() -> Iterator[list[bytes]]:
    """Every field of every message at extreme values."""
    return (frames for message in real(SESSION) for frames in extremes(message))


def main(address: str, token: str, seed: int) -> None:
    """Say a twelfth of everything, chosen by the seed, and each flood for a moment."""
    with ExitStack() as stack:
        hostile = Hostile(address, Path(token), stack)
        hostile.says(itertools.islice(sayings(), seed % 12, None, 12))
        for flood in FLOODS:
            hostile.floods(flood, 0.2, names=4)
        sys.stdout.write(f"said {hostile.said} messages in {hostile.sessions} sessions\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
