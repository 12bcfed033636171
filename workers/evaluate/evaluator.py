"""Plays the episodes of an Evaluate order. The result depends only on the order and the weights.

Rule: an order has k seeds, and is played on one lane of k env copies. The policy always gets a batch [1, k · A, ...], where
A is the number of seats of a copy. A copy whose episode has ended stays in the batch, but is not stepped. Rows are played in
small groups, each of which is then checked and sent; if the environment has to render, a group is a single row. The copies
don't belong to any training lane. They are opened once, and reset with a seed before each episode.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from time import perf_counter
from types import MappingProxyType

import numpy as np

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.envs.which_copy import EnvCopy
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import Evaluate, Evaluated, Weights
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.policy import Policy
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.specs import RunSpec
from millrace.workers.acting import Acting, StepActions, Stream
from millrace.workers.copies.env_copies import EvaluationCopies, check_spaces
from millrace.workers.copies.env_errors import environment_failed, environment_failures
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.looped_kind import loop_over
from millrace.workers.copies.value_checks import check_acted
from millrace.workers.copy_slots import EnvMaker
from millrace.workers.evaluate.episode_rows import RowSender, RowsOfEpisode, SendRows, as_frame
from millrace.workers.lanes.lane import Lane
from millrace.workers.lanes.rows import EpisodesLost, Rows, RowsOfLane
from millrace.workers.lanes.runner import LaneRunner, Part
from millrace.workers.lanes.running_episodes import EndedEpisode
from millrace.workers.opponents import KnownOpponents, Match, OtherTeams

ROWS_AT_ONCE = 16
"""Number of rows that are played before a check: enough to amortize its cost, and few enough to find wrong values early."""

OpenEvaluationCopies = Callable[[RunSpec, int, str | None, Pulse], EvaluationCopies]
"""Makes this many copies of a run's environment, with this render mode if it isn't None."""


def open_looped_copies(run: RunSpec, count: int, render_mode: str | None, pulse: Pulse) -> EvaluationCopies:
    """Make copies in this process. Raises `UsageError` if the environment does not support the render mode."""
    make = EnvMaker(run.env.for_evaluation(), render_mode)
    with warnings.catch_warnings():
        if render_mode is not None:
            warnings.simplefilter("ignore")  # gymnasium's warning about a render mode that is refused below
        copies = loop_over(run, make, count, EnvCopy(evaluation=True), pulse)
    modes = (copies.envs[0].metadata or {}).get("render_modes", [])  # some environments of the old package gym have None
    if render_mode is not None and (copies.envs[0].render_mode != render_mode or render_mode not in modes):
        copies.close()
        raise UsageError(f"environment {run.env.id} cannot be filmed: expected it to render {render_mode}, got {modes}")
    return copies


class Evaluator:
    """Plays whole episodes. Env copies are opened when they are first needed."""

    def __init__(
        self, run: RunSpec, policy: Policy | CalledPolicy, open_copies: OpenEvaluationCopies = open_looped_copies
    ) -> None:
        """Whenever `play` is called, `policy` must have the weights that are to be evaluated."""
        self.seconds = 0.0
        """seconds spent in `play`"""
        self._run = run
        self._runner = LaneRunner(run, policy)
        self._open_copies = open_copies
        self._opponents = KnownOpponents(run)
        self._copies: dict[str | None, EvaluationCopies] = {}  # keys are render modes
        self._ended_steps = 0  # env steps of all rows except those in progress
        self._under_way: Rows | None = None

    @property
    def steps(self) -> int:
        """Number of env steps made, including those of rows in progress."""
        return self._ended_steps + (0 if self._under_way is None else self._under_way.env_steps())

    def play(  # rule EVALUATE
        self, order: Evaluate, send: SendRows, pulse: Pulse, held: Mapping[int, Weights] = MappingProxyType({})
    ) -> Evaluated:
        """Play one episode for each seed. If the order asks for rows, they are passed to `send`.

        `held` has the weights of opponents, by version. `pulse` is called at every step and may raise. If it raises, or the
        environment does (`EnvironmentFailed`), all copies are closed.
        """
        began_s = perf_counter()
        try:
            while True:
                with suppress(EpisodesLost), environment_failures(None):  # lost episodes are played again from their seeds
                    return self._play(order, send, pulse, self._other_teams(order, held))
        except BaseException:
            self.close()
            raise
        finally:
            self.seconds += perf_counter() - began_s

    def close(self) -> None:
        """Close all copies."""
        while self._copies:
            self._copies.popitem()[1].close()

    def _play(self, order: Evaluate, send: SendRows, pulse: Pulse, others: OtherTeams | None) -> Evaluated:
        """Play an order. Raises `EpisodesLost` if env copies were lost with their worker."""
        run = self._run
        k = len(order.seeds)
        copies = self._opened(k, "rgb_array" if order.send_frames else None, pulse)
        stream = cache(partial(generator, order.seeds[0], Purpose.PLAYED_ACTIONS))  # rule EVALUATE_SEEDS
        lane = Lane(run, copies, k, number=None, most_steps=order.most_steps)
        lane.others = others
        lane.reset(order.seeds, pulse)
        senders = []
        if order.send_rows or order.send_frames:
            senders = [RowSender(order, n, send) for n in range(k)]
        rows = Rows(run, [lane], 1 if order.send_frames else ROWS_AT_ONCE)
        (of_lane,) = rows.of_lanes
        for sender in senders:
            self._show_frame(sender, copies)
            sender.begin(self._shown(sender.episode, of_lane, slice(0, 1)))
        actions = _PlayedActions(run, self._runner.acting, rows, stream, greedy=order.greedy)  # rule GREEDY
        ended_by_copy: dict[int, EndedEpisode] = {}
        while len(ended_by_copy) < k:
            self._fill(rows, actions, pulse)
            for each in of_lane.ended:
                ended_by_copy[each.copy] = each
            for sender in senders:
                n = sender.episode
                played = rows.filled - int(np.count_nonzero(of_lane.resets[: rows.filled, n]))
                if played:
                    self._show_frame(sender, copies)
                    sender.add(self._played(n, played, of_lane, actions.chosen, ended_by_copy.get(n)))
            rows.begin_again()
        ended = [ended_by_copy[n] for n in range(k)]
        return Evaluated(  # rule CUT
            order.session, order.ticket, tuple(each.episode for each in ended), tuple(each.cut for each in ended)
        )

    def _fill(self, rows: Rows, actions: StepActions, pulse: Pulse) -> None:
        """Play until these rows are full, and check them."""
        self._under_way = rows
        try:
            self._runner.run([Part(rows, actions)], pulse)
        finally:
            self._ended_steps += rows.env_steps()
            self._under_way = None
        self._runner.check(rows)

    def _other_teams(self, order: Evaluate, held: Mapping[int, Weights]) -> OtherTeams | None:
        """The teams that opponents play; None if the order names no opponents."""
        find = self._opponents.among(held)
        matches = [Match(team, find(number)) for team, number in zip(order.teams, order.opponents, strict=True)]
        if not matches:
            return None
        others = OtherTeams(self._run, matches)
        others.generator = generator(order.seeds[0], Purpose.PLAYED_OPPONENTS)
        return others

    def _opened(self, count: int, render_mode: str | None, pulse: Pulse) -> EvaluationCopies:
        """At least `count` copies with this render mode; opened if necessary.

        Raises `UsageError` if their spaces differ from the run's spaces.
        """
        copies = self._copies.get(render_mode)
        if copies is not None and copies.count >= count:
            return copies
        if copies is not None:
            self._copies.pop(render_mode).close()
        copies = self._copies[render_mode] = self._open_copies(self._run, count, render_mode, pulse)
        check_spaces(self._run, copies)
        return copies

    def _show_frame(self, sender: RowSender, copies: EvaluationCopies) -> None:
        """If the sender wants a frame, render the sender's copy and pass it the frame."""
        if not sender.wants_frame:
            return
        n = sender.episode
        try:
            sender.show(as_frame(copies.render(n)))
        except ValueError as error:
            raise environment_failed(None, f"copy {n}, {error}") from error

    def _played(self, n: int, L: int, rows: RowsOfLane, chosen: Array, ended: EndedEpisode | None) -> RowsOfEpisode:
        """The first L of these rows for copy n.

        `chosen` [T, k · A, *action] are the actions of all copies. `ended` is the copy's episode if it ended in row L - 1,
        else None.
        """
        cut = ended is not None and ended.cut
        if self._run.seats:
            terminated = np.zeros(L, bool)
            terminated[-1] = ended is not None and not cut
            truncated = np.zeros(L, bool)
        else:
            terminated = rows.terminated[:L, n]
            truncated = rows.truncated[:L, n]
        if cut:
            truncated = truncated.copy()
            truncated[-1] = True
        reward = rows.reward[:L].reshape(L, -1, self._run.seats_of_copy)[:, n].sum(-1)
        return RowsOfEpisode(
            tuple(self._shown(n, rows, slice(1, L + 1))), self._of_copy(n, chosen[:L]), reward, terminated, truncated
        )

    def _shown(self, n: int, rows: RowsOfLane, steps: slice) -> list[Array]:
        """Copy n's observations in these steps, without the mask, and without arrays that only the critic sees."""
        return [self._of_copy(n, leaf[steps]) for leaf in rows.obs[: len(self._run.policy.observation)]]

    def _of_copy(self, n: int, columns: Array) -> Array:
        """The part of an array [T, k · A, …] that belongs to copy n: [T, A, …] with seats, else [T, …]."""
        A = self._run.seats_of_copy
        return columns[:, n * A : (n + 1) * A] if self._run.seats else columns[:, n]


class _PlayedActions:
    """Chooses the actions of an evaluation, and checks them before an environment gets them."""

    def __init__(self, run: RunSpec, acting: Acting, rows: Rows, stream: Stream, *, greedy: bool) -> None:
        action = run.policy.action
        self.chosen = np.empty((rows.steps, rows.of_lanes[0].lane.columns, *action.shape), action.stored_dtype)
        """[T, k · A, *action] the actions of these rows"""
        self._run = run
        self._acting = acting
        self._rows = rows
        self._lane = rows.of_lanes[0].lane
        self._stream = stream
        self._greedy = greedy

    def act(self, t: int, obs: Sequence[Array], state: Floats) -> Array:
        """Choose the actions [1, k · A, *action]. Raises `EnvironmentFailed` if they are not finite.

        Actions of copies whose episodes have ended aren't checked.
        """
        chosen = self._acting.choose(obs, state, self._stream, greedy=self._greedy)
        if chosen.dtype.kind == "f":
            acted = np.zeros_like(chosen)
            playing = self._lane.playing.repeat(self._run.seats_of_copy)
            acted[playing] = chosen[playing]
            check_acted(None, "action", acted[None], obs, self._run.row_axes, self._rows.first_step + t)
        self.chosen[t] = chosen
        return chosen[None].copy()

    def written(self, i: int) -> list[Array]:
        """No arrays, because nothing is learned from these rows."""
        return []
