"""A `gymnasium.vector.VectorEnv` whose env copies live in worker processes, on this machine or on many.

The law: what comes out is, bit for bit, what `gymnasium.vector.SyncVectorEnv` gives for the same seeds and actions, however
it travels. What is lost with a worker is either told (its copies come back truncated) or raised: never hidden.
"""

from __future__ import annotations

import logging
import os
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space

from learner.vector_env.spec import Described
from learner.vector_env.step_hub import LockstepHub
from learner.vector_env.step_roster import Make
from protocol.arrays import Array
from protocol.envs.spaces import nester, reader
from protocol.errors import BadMessage, EnvironmentFailed, UsageError, WorkerLost
from protocol.messages import Answer, Call, LaneLife, Reset, Returned, Step, Stepped
from protocol.wire.plain_values import pack, shown_keys, unpack
from protocol.wire.shared_memory import Memory

log = logging.getLogger("millrace.learner")

Infos = dict[str, Any]
StepResult = tuple[Any, Array, Array, Array, Infos]
ATTEMPTS = 3  # workers that may be lost, one after another, while the same lane is reset


class ZmqVectorEnv(VectorEnv[Any, Any, Array]):
    """Env copies in worker processes, stepped together; `millrace.make_vec` makes it."""

    def __init__(
        self,
        described: Described,
        hub: LockstepHub,
        *,
        memory: Memory | None = None,
        timeout_s: float = 60.0,
        on_worker_loss: Literal["truncate", "raise"] = "truncate",
        copy: bool = True,
        shut: Callable[[], None] = lambda: None,
    ) -> None:
        """`memory`: shared with workers of this machine; `shut` is called once, when it is closed, forgotten or at exit."""
        if on_worker_loss not in ("truncate", "raise"):
            raise UsageError(f"on_worker_loss expected 'truncate' or 'raise', got {on_worker_loss!r}")
        step = described.step
        self.num_envs = N = len(step.copies)
        self.metadata = described.metadata
        self.render_mode = described.render_mode
        self.spec = described.spec
        self.single_observation_space, self.single_action_space = described.observation_space, described.action_space
        self.observation_space = batch_space(self.single_observation_space, N)
        self.action_space = batch_space(self.single_action_space, N)
        self.timeout_s, self.on_worker_loss, self.copy = timeout_s, on_worker_loss, copy
        self._hub, self._spec, self._memory = hub, step, memory
        self._lanes = range(len(step.lanes))
        self._firsts = [step.first(lane) for lane in self._lanes]
        self._read, self._nest = reader(self.single_action_space), nester(self.single_observation_space)
        self._obs: tuple[Array, ...]  # [num_envs, *leaf] each
        self._reward: Array
        self._terminated: Array
        self._truncated: Array
        if memory is not None:
            self._obs, self._reward = memory.obs, memory.reward
            self._terminated, self._truncated = memory.terminated, memory.truncated
        else:
            self._obs = tuple(np.zeros((N, *leaf.shape), leaf.dtype) for leaf in step.observation)
            self._reward, self._terminated, self._truncated = np.zeros(N), np.zeros(N, bool), np.zeros(N, bool)
        self._pending: Literal["", "step", "call"] = ""
        self._asked: Sequence[int] = ()  # lanes that the pending step was asked of
        self._lost: dict[int, str] = {}  # lanes that are gone, which nobody has been told of
        self._unborn: set[int] = set()  # lanes that live again, with copies that were never reset
        self._begun = np.zeros(N, bool)  # copies that were reset, ever
        self._seeds: list[int | None] = [None] * N
        self._shown: set[str] = set()  # keys of infos that arrived as their repr
        self._finalizer = weakref.finalize(self, _shut_once, os.getpid(), shut)

    # ---------------------------------------------------------------- reset

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Infos]:
        """Begin episodes in all copies, or in those of `options["reset_mask"]`; observations and infos."""
        self._check_idle("reset")
        seeds = self._seeds_of(seed)
        mask, options = self._mask_of(options)
        chosen = {lane: [n for n in range(self._spec.lanes[lane]) if mask[self._firsts[lane] + n]] for lane in self._lanes}
        if mask.all():
            self._hub.renew()
            self._lost.clear()
            self._hub.lost()
        infos = self._reset({lane: copies for lane, copies in chosen.items() if copies}, seeds, options)
        self._begun |= mask
        return self._observations(), self._merged(infos)

    def _reset(self, chosen: Mapping[int, list[int]], seeds: Sequence[int | None], options: Any) -> dict[int, bytes]:
        """Begin episodes in these copies of these lanes, again wherever a worker is lost; packed infos by lane."""
        packed = _bytes(pack(options))

        def make(lane: int, copies: list[int]) -> Make:
            mine = tuple(seeds[self._firsts[lane] + n] for n in copies)

            def order(session: int, ticket: int, life: LaneLife) -> Reset:
                return Reset(session, ticket, life.lane, life.incarnation, tuple(copies), mine, packed)

            return order

        infos: dict[int, bytes] = {}
        wanted = dict(chosen)
        for attempt in range(ATTEMPTS):
            self._hub.say({lane: make(lane, copies) for lane, copies in wanted.items()})
            answers = self._hub.hear(self.timeout_s)
            infos |= self._keep(answers)
            wanted = {lane: copies for lane, copies in wanted.items() if lane not in answers}
            self._unborn -= answers.keys()
            lost = self._hub.lost()
            self._lost |= {lane: why for lane, why in lost.items() if lane not in wanted and not self._hub.lives(lane)}
            if not wanted:
                return infos
            if self.on_worker_loss == "raise" or attempt == ATTEMPTS - 1:
                self._unborn |= wanted.keys()
                raise self._worker_lost(lost)
        return infos

    def _seeds_of(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            seeds: list[int | None] = [None] * self.num_envs
        elif isinstance(seed, int | np.integer):
            seeds = [int(seed) + n for n in range(self.num_envs)]
        else:
            seeds = [None if one is None else int(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed expected one for each of {self.num_envs} copies, got {len(seeds)}")
        self._seeds = [new if new is not None else old for new, old in zip(seeds, self._seeds, strict=True)]
        return seeds

    def _mask_of(self, options: dict[str, Any] | None) -> tuple[Array, dict[str, Any] | None]:
        if options is None or "reset_mask" not in options:
            return np.ones(self.num_envs, bool), options
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] expected an array of bool, got {getattr(mask, 'dtype', type(mask))}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"options['reset_mask'] expected shape ({self.num_envs},) and at least one True, got {mask}")
        return mask, {key: value for key, value in options.items() if key != "reset_mask"}

    # ---------------------------------------------------------------- step

    def step(self, actions: Any) -> StepResult:
        """Step every copy: observations, rewards, terminated, truncated, infos."""
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: Any) -> None:
        """Tell every copy to step; `step_wait` has what came of it."""
        self._check_idle("step_async")
        leaves, fit = self._action_leaves(actions)
        if not self._begun.all():
            raise UsageError(f"step before reset of copies {np.flatnonzero(~self._begun).tolist()}: call reset() first")
        if self._spec.autoreset == "Disabled" and (ended := self._terminated | self._truncated).any():
            raise UsageError(
                f"copies {np.flatnonzero(ended).tolist()} have ended: autoreset_mode is Disabled, expected "
                "reset(options={'reset_mask': ended}) before the next step"
            )
        self._lost |= self._hub.lost()
        if self._unborn and self.on_worker_loss == "raise":
            raise WorkerLost(f"lanes {sorted(self._unborn)} were lost with their worker; call reset() first")
        self._asked = [lane for lane in self._lanes if lane not in self._lost]
        self._pending = "step"
        if fit and self._memory is not None and not self._unborn and all(map(self._hub.shares, self._asked)):
            for array, leaf in zip(self._memory.actions, leaves, strict=True):
                array[:] = leaf
            self._hub.step_shared(self._asked)
        else:
            self._hub.say({lane: self._step_order(lane, leaves) for lane in self._asked})

    def step_wait(self, timeout: float | None = None) -> StepResult:
        """What the pending step gave. Whoever has not answered within `timeout` seconds (`timeout_s`) is given up."""
        if self.closed:
            raise ClosedEnvironmentError("step_wait after close()")
        if self._pending != "step":
            raise NoAsyncCallError("step_wait without step_async before it", "step")
        hub, timeout_s = self._hub, self.timeout_s if timeout is None else timeout
        try:
            answers = hub.hear(timeout_s)
        except Exception:
            self._pending = ""
            self._unborn |= hub.lost().keys()
            raise
        self._pending = ""
        infos = self._keep(answers)
        self._unborn -= answers.keys()
        if hub.stepped:
            infos |= {lane: hub.infos(lane, timeout_s) for lane in sorted(hub.stepped)}
        if self._lost or len(answers) + len(hub.stepped) < len(self._asked):
            return self._with_losses(infos, {*answers, *hub.stepped})
        return (
            self._observations(),
            self._reward.copy(),
            self._terminated.copy(),
            self._truncated.copy(),
            self._merged(infos),
        )

    def _step_order(self, lane: int, leaves: Sequence[Array]) -> Make:
        rows = slice(self._firsts[lane], self._firsts[lane] + self._spec.lanes[lane])
        if lane in self._unborn:  # NEXT_STEP: the step after a truncation resets
            N = self._spec.lanes[lane]
            incarnation = self._hub.lockstep.seats[lane].incarnation
            seeds = tuple(_seed_again(seed, incarnation) for seed in self._seeds[rows])

            def reset(session: int, ticket: int, life: LaneLife) -> Reset:
                return Reset(session, ticket, life.lane, life.incarnation, tuple(range(N)), seeds, _bytes(pack(None)))

            return reset
        mine = tuple(leaf[rows].copy() for leaf in leaves)

        def step(session: int, ticket: int, life: LaneLife) -> Step:
            return Step(session, ticket, life.lane, life.incarnation, mine)

        return step

    def _with_losses(self, infos: dict[int, bytes], answered: set[int]) -> StepResult:
        """The step's result where some lanes have none: their copies are truncated at their newest observation."""
        self._lost |= self._hub.lost()  # whoever answered and was lost then is told of in the next step
        lost = {lane: self._lost.pop(lane) for lane in self._lanes if lane in self._lost and lane not in answered}
        for lane in self._lanes:
            if lane not in answered:
                lost.setdefault(lane, "its worker is gone")
        self._unborn |= lost.keys()
        if self.on_worker_loss == "raise":
            raise self._worker_lost(lost)
        for lane, why in lost.items():
            first, copies = self._firsts[lane], self._spec.lanes[lane]
            log.warning("%s; its lane %d comes back truncated (copies %d to %d)", why, lane, first, first + copies - 1)
            rows = slice(first, first + copies)
            self._reward[rows], self._terminated[rows], self._truncated[rows] = 0.0, False, True
        result = self._reward.copy(), self._terminated.copy(), self._truncated.copy()
        told: dict[int, Infos] = {n: {"worker_lost": True} for lane in lost for n in self._copies(lane)}
        if self._spec.autoreset == "SameStep":
            for n in told:
                last = self._nest([array[n].copy() for array in self._obs])
                told[n] |= {"final_obs": last, "final_info": {"worker_lost": True}}
            seeds = list(self._seeds)
            for lane in lost:
                for n in self._copies(lane):
                    seeds[n] = _seed_again(seeds[n], self._hub.lockstep.seats[lane].incarnation)
            infos |= self._reset({lane: list(range(self._spec.lanes[lane])) for lane in lost}, seeds, None)
        return self._observations(), *result, self._merged(infos, told)

    def _action_leaves(self, actions: Any) -> tuple[list[Array], bool]:
        """Arrays [num_envs, …], and whether they are what shared memory holds: of the space's dtype and shape."""
        leaves, fit = [], True
        for leaf, given in zip(self._spec.action, self._read(actions), strict=True):
            array = np.asarray(given)
            if array.ndim == 0 or len(array) != self.num_envs:
                raise (ValueError if array.ndim else TypeError)(
                    f"actions expected one for each of {self.num_envs} copies, got shape {list(array.shape)}"
                )
            if array.dtype.kind not in "biuf":
                raise TypeError(f"actions expected numbers, got {array.dtype}")
            fit = (
                fit and array.shape[1:] == leaf.shape and (array.dtype == leaf.dtype or np.can_cast(array.dtype, leaf.dtype))
            )
            leaves.append(array)
        return leaves, fit

    # ---------------------------------------------------------------- calls

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What the attribute of that name is, or gives when it is called, for every copy. All of it plain data."""
        return self.call_some(range(self.num_envs), name, *args, **kwargs)

    def call_some(self, copies: Sequence[int], name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """The same, for some copies, in ascending order."""
        return self._call(copies, name, dict.fromkeys(self._lanes, (args, kwargs)), assign=False)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every copy."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute: a list or tuple has one value for each copy, anything else is everybody's."""
        if not isinstance(values, list | tuple):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"values expected one for each of {self.num_envs} copies, got {len(values)}")
        self.assign_some(range(self.num_envs), name, values)

    def assign_some(self, copies: Sequence[int], name: str, values: Sequence[Any]) -> None:
        """Set an attribute of some copies, which are in ascending order, one value each."""
        given: dict[int, Any] = {lane: [] for lane in self._lanes}
        for n, value in zip(copies, values, strict=True):
            given[self._lane_of(n)].append(value)
        self._call(copies, name, given, assign=True)

    def render(self) -> tuple[Any, ...]:
        """What `render` gives for every copy."""
        return self.call("render")

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each copy's generator, as SyncVectorEnv shows it."""
        return self.get_attr("np_random_seed")

    def _call(self, copies: Sequence[int], name: str, given: Mapping[int, Any], *, assign: bool) -> tuple[Any, ...]:
        self._check_idle("call")
        if name in ("reset", "step", "close") and not assign:
            raise ValueError(f"call of {name!r}: use {name}() of the vector environment")
        chosen: dict[int, list[int]] = {}
        for n in sorted(copies):
            chosen.setdefault(self._lane_of(n), []).append(n - self._firsts[self._lane_of(n)])

        def make(lane: int) -> Make:
            packed = _bytes(pack(given[lane]))
            return lambda session, ticket, life: Call(
                session, ticket, life.lane, life.incarnation, tuple(chosen[lane]), name, assign, packed
            )

        self._hub.say({lane: make(lane) for lane in chosen})
        answers = self._hub.hear(self.timeout_s)
        if missing := [lane for lane in chosen if lane not in answers]:
            self._lost |= (lost := self._hub.lost())
            raise self._worker_lost({lane: lost.get(lane, "its worker is gone") for lane in missing})
        results: list[Any] = []
        for lane in chosen:
            answer = answers[lane]
            assert isinstance(answer, Returned)
            if answer.error:
                raise _call_failed(name, lane, answer)
            results += unpack(answer.results.data) if not assign else []
        return tuple(results)

    # ---------------------------------------------------------------- the workers

    @property
    def workers(self) -> int:
        """How many are here."""
        return len(self._hub.lockstep.members)

    def wait_for(self, workers: int, timeout_s: float) -> None:
        """Wait until so many have joined. Raises `NoWorkers`."""
        self._hub.wait_for(workers, timeout_s)

    def watch(self, look: Callable[[], None]) -> None:
        """Call this now and then while waiting; what it raises ends the wait."""
        self._hub.watch = look

    # ---------------------------------------------------------------- the end

    def close_extras(self, **kwargs: Any) -> None:
        """Ask the workers to leave, and end those that are ours; never hangs."""
        self._finalizer()

    def __enter__(self) -> ZmqVectorEnv:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # ---------------------------------------------------------------- inside

    def _check_idle(self, doing: str) -> None:
        if self.closed:
            raise ClosedEnvironmentError(f"{doing} after close()")
        if self._pending:
            raise AlreadyPendingCallError(f"{doing} while a step is pending: expected step_wait() first", self._pending)

    def _lane_of(self, copy: int) -> int:
        if not 0 <= copy < self.num_envs:
            raise IndexError(f"copy expected 0 to {self.num_envs - 1}, got {copy}")
        return max(lane for lane in self._lanes if self._firsts[lane] <= copy)

    def _copies(self, lane: int) -> range:
        return range(self._firsts[lane], self._firsts[lane] + self._spec.lanes[lane])

    def _keep(self, answers: Mapping[int, Answer]) -> dict[int, bytes]:
        """Lay what came as messages where all of it lies; packed infos by lane."""
        infos = {}
        for lane, answer in answers.items():
            if isinstance(answer, Stepped) and answer.ticket > 0:
                rows = slice(self._firsts[lane], self._firsts[lane] + self._spec.lanes[lane])
                for array, leaf in zip(self._obs, answer.obs, strict=True):
                    array[rows] = leaf
                self._reward[rows], self._terminated[rows] = answer.reward, answer.terminated
                self._truncated[rows] = answer.truncated
                infos[lane] = bytes(answer.infos.data)
        return infos

    def _observations(self) -> Any:
        return self._nest([array.copy() for array in self._obs] if self.copy else self._obs)

    def _merged(self, packed: Mapping[int, bytes], told: Mapping[int, Infos] | None = None) -> Infos:
        """Infos of all copies as gymnasium merges them, in the order of the copies."""
        by_copy: dict[int, Infos] = dict(told or {})
        for lane, data in packed.items():
            if not data:
                continue
            try:
                found = {self._firsts[lane] + n: info for n, info in unpack(data) if n in range(self._spec.lanes[lane])}
                for n, info in found.items():
                    by_copy[n] = by_copy.get(n, {}) | info
            except (BadMessage, TypeError, ValueError) as error:
                self._hub.distrust(lane, f"lane {lane}: infos cannot be read: {error}")
        infos: Infos = {}
        for n in sorted(by_copy):
            infos = self._add_info(infos, by_copy[n], n)
            for key in shown_keys(by_copy[n]):
                if key not in self._shown:
                    self._shown.add(key)
                    log.warning("info %s of copy %d is no plain data: it comes as its repr, a string", key, n)
        return infos

    def _worker_lost(self, lost: Mapping[int, str]) -> WorkerLost:
        whys = [
            f"{why}: lane {lane} (copies {self._copies(lane)[0]} to {self._copies(lane)[-1]}) is lost"
            for lane, why in lost.items()
        ]
        return WorkerLost("; ".join(whys) or "a worker was lost")


def _seed_again(seed: int | None, incarnation: int) -> int | None:
    """A seed for a copy that stands for a lost one: another than its, and the same whenever it is lost so."""
    return None if seed is None else int(np.random.SeedSequence([seed, incarnation]).generate_state(1)[0] >> 1)


def _bytes(data: bytes) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


def _call_failed(name: str, lane: int, answer: Returned) -> Exception:
    """What a call raised, with the worker's own traceback: an AttributeError stays one, for whoever asks what there is."""
    line = f"call of {name!r}, lane {lane}: {answer.error}"
    missing = answer.error.startswith("AttributeError")
    error: Exception = AttributeError(line) if missing else EnvironmentFailed(line, answer.traceback)
    error.add_note(answer.traceback)
    return error


def _shut_once(pid: int, shut: Callable[[], None]) -> None:
    if os.getpid() == pid:  # a forked child has a copy of this object, and not the workers
        shut()
