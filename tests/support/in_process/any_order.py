"""A vector environment whose lanes answer in any order that a test chooses. Hub and env copies are real, processes are not.

The workers are `Stepper`s in this process. An order lies on the link, or in shared memory, until the test's choice executes
it. Time is a number that only waiting moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import cast

from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.learner.vector_env.shared_steps import SharedSteps
from millrace.learner.vector_env.spec import requested_copies
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.messages import Call, Failure, Goodbye, Hello, Order, Refuse, Reset, Step, Welcome
from millrace.protocol.specs import StepSpec
from millrace.protocol.wire.codec import Buffer, decode_to_worker
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.shared_memory import InheritedDescriptors, SharedMemory, new_memory
from millrace.protocol.wire.wake_up import WakePipe
from millrace.workers.vector_env.stepper import Stepper
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_link import FakeLink
from tests.support.in_process.described import described

Choose = Callable[[int], int]
"""Chooses one of so many."""


def first(count: int) -> int:
    """The oldest order first."""
    return 0


def no_pulse() -> None:
    """Nothing else to do."""


class AnyOrder(FakeLink):
    """The link to workers that execute orders when and in the order that `choose` says."""

    def __init__(self) -> None:
        super().__init__()
        self.choose: Choose = first
        self.held: list[tuple[str, Order]] = []  # with the worker's name
        self.frozen: set[str] = set()  # workers that do nothing
        self.orders: list[Order] = []  # all that came as messages
        self.memory: SharedMemory | None = None
        self._descriptors: dict[str, InheritedDescriptors] = {}
        self._sessions: dict[str, int] = {}
        self._steppers: dict[str, Stepper] = {}
        self._nonce = 0

    def join(self, name: str) -> None:
        """A worker with this name says Hello."""
        self._nonce += 1
        self.inbox.append((name.encode(), example(Hello, worker=name, process_nonce=self._nonce)))

    def leave(self, name: str) -> None:
        """The worker of this name is gone, with its env copies."""
        self._end(name)
        self.inbox.append((name.encode(), Goodbye(self._sessions.pop(name), "killed", ())))

    def share(self, spec: StepSpec, names: Sequence[str], resources: ExitStack) -> SharedSteps:
        """Shared memory and pipes for these workers."""
        self.memory = memory = SharedMemory(spec, new_memory(), resize=True)
        to_learner = WakePipe()
        to_workers = {name: WakePipe() for name in names}
        for pipe in (to_learner, *to_workers.values()):
            resources.callback(pipe.close)
        resources.callback(memory.close)
        for name, to_worker in to_workers.items():
            self._descriptors[name] = InheritedDescriptors(memory.fd, to_worker.read_fd, to_learner.write_fd)
        return SharedSteps(memory, to_workers, to_learner)

    def close_workers(self) -> None:
        """Close all env copies."""
        for name in list(self._steppers):
            self._end(name)

    def poll(self, timeout_s: float) -> bool:
        self._execute(at_least_one=timeout_s > 0 and not self.inbox)
        return super().poll(timeout_s)

    def poll_beside(self, fds: Sequence[int], timeout_s: float) -> bool:
        """Waits for messages or for steps through shared memory."""
        if not self._execute(at_least_one=not self.inbox) and not self.inbox:
            self.now += timeout_s
        return bool(self.inbox)

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        name, message = peer.decode(), decode_to_worker([bytes(frame) for frame in frames])
        match message:
            case Welcome(session, _, StepSpec() as spec):
                self._sessions[name] = session
                self._steppers[name] = Stepper(spec, self._descriptors.get(name))
            case Refuse():
                self._end(name)
            case Reset() | Step() | Call():
                self.orders.append(message)
                if name in self._steppers:
                    self.held.append((name, message))
            case _:
                pass
        return True

    def _end(self, name: str) -> None:
        self.held = [(worker, order) for worker, order in self.held if worker != name]
        if (stepper := self._steppers.pop(name, None)) is not None:
            stepper.lanes.close_all()

    def execute(self) -> None:
        """Execute at least one order, if one waits."""
        self._execute(at_least_one=True)

    def _execute(self, *, at_least_one: bool) -> int:
        """Execute some of the orders that wait. How many."""
        executed = 0
        while waiting := self._waiting():
            chosen = self.choose(len(waiting) + (not at_least_one))
            if chosen >= len(waiting):
                break
            waiting[chosen]()
            executed += 1
            at_least_one = False
        return executed

    def _waiting(self) -> list[Callable[[], None]]:
        by_message = [(name, order) for name, order in self.held if name not in self.frozen]
        shared = [name for name in sorted(self._steppers) if name not in self.frozen and self._has_shared_order(name)]
        return [
            *(lambda name=name, order=order: self._answer(name, order) for name, order in by_message),
            *(lambda name=name: self._serve(name) for name in shared),
        ]

    def _has_shared_order(self, name: str) -> bool:
        stepper = self._steppers[name]
        return stepper.uses_shared_memory and stepper._has_order()

    def _answer(self, name: str, order: Order) -> None:
        self.held.remove((name, order))
        try:
            answer = self._steppers[name].execute(order, no_pulse)
        except EnvironmentFailed as error:
            self._fail(name, error)
        else:
            self.inbox.append((name.encode(), answer))

    def _serve(self, name: str) -> None:
        try:
            self._steppers[name].serve_shared_memory(
                0.0, no_pulse, self._sessions[name], lambda answer: self.inbox.append((name.encode(), answer))
            )
        except EnvironmentFailed as error:
            self._fail(name, error)

    def _fail(self, name: str, error: EnvironmentFailed) -> None:
        self.inbox.append(
            (
                name.encode(),
                example(Failure, session=self._sessions[name], error=str(error), traceback="traceback", lane=error.lane),
            )
        )
        self._end(name)


@contextmanager
def any_order(settings: VectorEnvSettings, workers: int, *, shared: bool) -> Iterator[tuple[ZmqVectorEnv, AnyOrder]]:
    """A vector environment with workers w0, w1, …, and the link by which the test commands them."""
    link, names = AnyOrder(), [f"w{n}" for n in range(workers)]
    requested = requested_copies(settings)
    description = requested.description(_described(requested.envs[0].id))
    with ExitStack() as resources:
        steps = link.share(description.step, names, resources) if shared else None
        resources.callback(link.close_workers)
        hub = StepHub(
            cast(LearnerLink, link),
            description.step,
            first_session=1,
            processes=WorkerProcesses(),
            shared=steps,
            clock=lambda: link.now,
        )
        env = ZmqVectorEnv(
            description,
            hub,
            timeout_s=settings.timeout_s,
            on_worker_loss=settings.on_worker_loss,
        )
        for name in names:
            link.join(name)
        env.hub.wait_for(workers, 1.0)
        yield env, link


@cache
def _described(env_id: str) -> DescribedEnv:
    """Keyword arguments of these environments do not change their spaces."""
    return described(EnvSpec(env_id))
