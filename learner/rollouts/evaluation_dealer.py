"""The tickets of one evaluation: which episodes are still to be played, and who plays them. Pure.

Rule: the seeds are divided into tickets of `copies` seeds, whatever the number of workers, so the result does not depend on
that number. If an evaluation runs alongside training, only the workers that do nothing but evaluate play it; otherwise all
active workers do, including those without a lane. A ticket whose worker is lost goes to another worker. The numbers of these
tickets start at `FIRST_TICKET`, far above those of rollouts, and the ledger does not count them.

Rule: a worker that claims to play and never answers must not block the learner forever, but it can't be told from a slow
one. Therefore, if a worker takes too long (`stall_watch.py` says when), `share` gives its ticket to a second worker as well.
The first answer counts; it does not matter whose it is, because the seeds determine the episodes. Until it joins again, the
late worker gets tickets only if nobody else can play.

Rule: rows count only together with the answer of the worker that sent them. If a worker is lost, or its answer can't be
used, its rows are dropped, and its ticket is played again from the start.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from millrace.learner.members.member import Member, SentTicket
from millrace.learner.members.membership import Outgoing
from millrace.learner.run_folder.results import Evaluation, fact_means
from millrace.protocol.bounds import LARGEST
from millrace.protocol.messages import EpisodeRows, Evaluate, Evaluated
from millrace.protocol.random_streams import Purpose, env_seed
from millrace.protocol.rollout import Episode
from millrace.protocol.rows.played import reason_to_reject
from millrace.protocol.rows.rollout_checks import wrong_episode
from millrace.protocol.specs import RunSpec

FIRST_TICKET = 1 << 52
HELD_AT_ONCE = 2  # how many tickets a worker may hold: while the learner reads one answer, the worker plays the other

OnRows = Callable[[int, EpisodeRows], None]
"""Called with the number of an episode (the index of its seed in the plan) and some of its rows, in order.

It is called with all rows of a ticket in succession, once the answer to the ticket has arrived.
"""


@dataclass(frozen=True)
class EvaluationPlan:
    """The episodes of one evaluation."""

    seeds: tuple[int, ...]
    """the reset seed of each episode"""
    copies: int
    """the number of seeds in a ticket, which is how many episodes a worker plays at the same time"""
    most_steps: int
    """the number of env steps at which an episode is cut off"""
    time_limit: int | None = None
    """the number of env steps after which the environment itself truncates an episode, if that is known. It is only shown"""
    greedy: bool = True
    """whether to take the most probable actions; if not, actions are sampled"""
    send_rows: bool = False
    send_frames: bool = False
    of_best: bool = False
    """whether the weights are those of the run's best policy"""
    opponents: tuple[int, ...] = ()
    """in a run with teams, the opponents, which play in turn. They are numbered as in a `Permit`"""

    @staticmethod
    def of(episodes: int, seed: int, copies: int, max_steps: int, purpose: Purpose = Purpose.EPISODES) -> EvaluationPlan:
        """A plan of greedy episodes, with reset seeds for this purpose.

        `max_steps` is how many env steps the whole evaluation may take. Each episode gets an equal share, at least one step.
        """
        most_steps = min(max(1, max_steps // episodes), LARGEST)
        of_best = purpose is Purpose.CONFIRMATION
        return EvaluationPlan(episode_seeds(seed, episodes, purpose), copies, most_steps, of_best=of_best)

    def seeds_of_tickets(self) -> list[tuple[int, ...]]:
        """The seeds of each ticket."""
        return [self.seeds[i : i + self.copies] for i in range(0, len(self.seeds), self.copies)]

    def how_far(self, played: int, env_steps: int, bound: str = "at most", before: tuple[int, int] = (0, 0)) -> str:
        """The evaluation's progress in words. `env_steps` includes the steps of running episodes.

        `bound` introduces the largest number of steps, for example with the name of a flag. `before` are the episodes and
        env steps of earlier plans.
        """
        episodes, steps = before
        counted = f"{episodes + played:,} of {episodes + len(self.seeds):,} episodes, {steps + env_steps:,} env steps"
        return f"{counted} ({bound} {self.most_steps:,} each)"

    @property
    def longest_episode(self) -> int:
        """The largest number of env steps that an episode may have."""
        return self.most_steps if self.time_limit is None else min(self.most_steps, self.time_limit)


def episode_seeds(seed: int, episodes: int, purpose: Purpose = Purpose.EPISODES) -> tuple[int, ...]:
    """The reset seed of each episode. More episodes only add seeds at the end."""
    return tuple(env_seed(seed, purpose, episode) for episode in range(episodes))


@dataclass(frozen=True)
class PlayedEpisode:
    """An episode that was played to its end or was cut off."""

    episode: Episode
    cut: bool


def evaluation_of(played: Sequence[PlayedEpisode], facts: Sequence[str] = ()) -> Evaluation:
    """The evaluation that consists of these episodes. `facts` are the names of their facts."""
    episodes = [one.episode for one in played]
    cut = sum(one.cut for one in played)
    evaluation = Evaluation.of([episode.reward for episode in episodes], [episode.length for episode in episodes], cut)
    if not facts:
        return evaluation
    matches = sum(episode.opponent is not None for episode in episodes)
    means = fact_means(facts, [episode.facts for episode in episodes])
    return msgspec.structs.replace(evaluation, facts=means, matches=matches)


class TakenAnswer(NamedTuple):
    """What became of an answer."""

    ended: bool = False
    """Whether the worker's ticket has ended. If not, the worker no longer had the ticket, and the answer is ignored."""
    accepted: bool = False
    """Whether the answer's episodes count."""
    why: str = ""
    """What is wrong with the answer; empty if nothing is."""


class PendingEvaluation:
    """The tickets of an evaluation that has begun and not ended, and the answers so far."""

    def __init__(
        self,
        plan: EvaluationPlan,
        version: int,
        run: RunSpec,
        *,
        first: int,
        most_copies: int | None,
        late: set[int],
        on_rows: OnRows | None = None,
        beside: bool = False,
    ) -> None:
        """`run` describes the form of rows and episodes, and `first` is the number of the first ticket.

        See `EvaluationDealer` for `most_copies` and for `late`, to which this evaluation adds.
        """
        self.plan = plan
        self.version = version
        """the version of the weights that are evaluated"""
        self.beside = beside
        """whether the evaluation runs alongside training"""
        self.seeds = plan.seeds_of_tickets()
        self.playing: dict[int, list[Member]] = {}
        """by the number of each ticket that is being played, its worker, then the second worker if `share` added one"""
        self._run = run
        self._first = first
        self._most_copies = most_copies
        self._most_workers = 0  # if copies are limited, how many workers may play; 0 for as many as the limit allows
        self._late = late
        self._on_rows = on_rows
        self._undealt = list(range(len(self.seeds)))  # a heap of the indices of tickets that no worker has
        self._played: dict[int, Evaluated] = {}  # answers, by index of the ticket
        self._rows: dict[tuple[int, bytes], dict[int, list[EpisodeRows]]] = {}  # by ticket index and worker, then by episode

    @property
    def done(self) -> bool:
        """Whether all episodes have been played."""
        return len(self._played) == len(self.seeds)

    @property
    def episodes_played(self) -> int:
        """The number of episodes that have been played."""
        return sum(len(self.seeds[index]) for index in self._played)

    @property
    def players(self) -> list[Member]:
        """The workers that hold tickets."""
        return list({member.peer: member for members in self.playing.values() for member in members}.values())

    def all_play(self) -> None:
        """Let all workers play the evaluation, which has run alongside training so far.

        If copies are limited, only one of the other workers plays.
        """
        self.beside = False
        self._most_workers = 1

    def episodes(self) -> list[PlayedEpisode]:
        """The episodes that have been played, in the order of the seeds."""
        answers = [answer for _, answer in sorted(self._played.items())]
        return [PlayedEpisode(*both) for answer in answers for both in zip(answer.episodes, answer.cut, strict=True)]

    def deal(self, active: Sequence[Member]) -> list[Outgoing]:
        """Give a ticket to each of these workers that may play, then a second one if there are more tickets than workers.

        Workers that only evaluate come first, then the others, each in the order of joining. If copies are limited, only the
        first workers play, because a worker keeps its copies.
        """
        out = list[Outgoing]()
        members = self._who_may_play([member for member in active if member.hello.evaluates or not self.beside])
        holds = self._held_by()
        for most in range(1, HELD_AT_ONCE + 1):
            for member in members:
                plenty = most == 1 or len(self._undealt) > len(members)
                if self._undealt and plenty and holds[member.peer] < most:
                    number = self._first + heapq.heappop(self._undealt)
                    self.playing[number] = [member]
                    holds[member.peer] += 1
                    out += self.send(member, [number])
        return out

    def share(self, active: Sequence[Member]) -> list[Outgoing]:
        """Give the oldest ticket that only one worker is playing to a second, idle worker as well."""
        who = [member for member in active if member.hello.evaluates or not self.beside or self._most_copies is None]
        holds = self._held_by()
        idle = [member for member in self._who_may_play(who) if not holds[member.peer]]
        alone = [number for number, members in self.playing.items() if len(members) == 1]
        if not idle or not alone:
            return []
        oldest = min(alone)
        self.playing[oldest].append(idle[0])
        return self.send(idle[0], [oldest])

    def send(self, member: Member, tickets: Iterable[int]) -> list[Outgoing]:
        """Make the orders for the evaluation's tickets among these."""
        return [(member.peer, self._order(member, number)) for number in tickets if number in self.playing]

    def take_in(self, member: Member, answer: Evaluated) -> TakenAnswer:
        """Accept an answer. If its episodes can't be used, they are played again."""
        if not self._plays(member, answer.ticket):
            return TakenAnswer()  # a repeat, or the answer of an earlier evaluation, or of the slower of two workers
        index = answer.ticket - self._first
        if why := self._wrong(answer, len(self.seeds[index])):
            self.lose(member, answer.ticket)
            return TakenAnswer(ended=True, why=f"evaluation of ticket {answer.ticket}: {why}")
        rows = self._rows.get((index, member.peer), {})
        if self._on_rows is not None:
            if [_end(rows.get(n, ())) for n in range(len(answer.episodes))] != [one.length for one in answer.episodes]:
                self.lose(member, answer.ticket)  # a message with rows was lost, so the episodes are played again
                return TakenAnswer(ended=True)
            for episode, messages in sorted(rows.items()):
                for message in messages:
                    self._on_rows(index * self.plan.copies + episode, message)
        members = self.playing.pop(answer.ticket)
        if members[0] is not member:
            self._late.add(members[0].session)
        for each in members:
            self._forget(each, answer.ticket)
        self._played[index] = answer
        return TakenAnswer(ended=True, accepted=True)

    def take_rows(self, member: Member, rows: EpisodeRows) -> str:
        """Store rows until their answer arrives.

        Returns what is wrong with them, or an empty string. Repeated rows are ignored.
        """
        if not self._plays(member, rows.ticket) or self._on_rows is None:
            return ""
        index = rows.ticket - self._first
        if rows.episode >= len(self.seeds[index]):
            return f"rows of ticket {rows.ticket}: expected an episode below {len(self.seeds[index])}, got {rows.episode}"
        come = self._rows.setdefault((index, member.peer), {}).setdefault(rows.episode, [])
        if rows.first_step != _end(come):
            return ""
        if why := reason_to_reject(rows, come, self._run, self.plan.most_steps, self.plan.send_frames):
            return f"rows of ticket {rows.ticket}: {why}"
        come.append(rows)
        return ""

    def lose(self, member: Member, number: int) -> None:
        """Record that a member no longer plays this ticket. If nobody else plays it, it will be dealt again."""
        self._forget(member, number)
        self.playing[number].remove(member)
        if not self.playing[number]:
            del self.playing[number]
            heapq.heappush(self._undealt, number - self._first)

    # ---------------------------------------------------------------- inside

    def _plays(self, member: Member, number: int) -> bool:
        return member in self.playing.get(number, ())

    def _held_by(self) -> Counter[bytes]:
        """How many tickets each worker holds."""
        return Counter(member.peer for members in self.playing.values() for member in members)

    def _who_may_play(self, members: Sequence[Member]) -> list[Member]:
        """The workers among these that may play. A worker that was late may play only if all were late.

        Workers that only evaluate come first. If copies are limited, only the first workers play, because a worker keeps its
        copies.
        """
        players = sorted(members, key=lambda member: not member.hello.evaluates)
        players = [member for member in players if member.session not in self._late] or players
        if self._most_copies is None:
            return players
        return players[: self._most_workers or max(1, self._most_copies // self.plan.copies)]

    def _forget(self, member: Member, number: int) -> None:
        """Take the ticket from this member, and drop its rows."""
        del member.tickets[number]
        self._rows.pop((number - self._first, member.peer), None)

    def _order(self, member: Member, number: int) -> Evaluate:
        plan = self.plan
        opponents, teams = self._matches(number)
        order = Evaluate(
            session=member.session,
            ticket=number,
            version=self.version,
            seeds=self.seeds[number - self._first],
            greedy=plan.greedy,
            most_steps=plan.most_steps,
            send_rows=plan.send_rows,
            send_frames=plan.send_frames,
            opponents=opponents,
            teams=teams,
        )
        member.tickets[number] = SentTicket(member.replies, order.versions)
        return order

    def _matches(self, number: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The opponents and the evaluated teams of a ticket's episodes, chosen so that each opponent meets all teams."""
        plan = self.plan
        count = len(self._run.teams)
        if not count:
            return (), ()
        index = number - self._first
        episodes = range(index * plan.copies, index * plan.copies + len(self.seeds[index]))
        opponents = tuple(plan.opponents[episode // count % len(plan.opponents)] for episode in episodes)
        return opponents, tuple(episode % count for episode in episodes)

    def _wrong(self, answer: Evaluated, seeds: int) -> str:
        if len(answer.episodes) != seeds or len(answer.cut) != seeds:
            return f"expected {seeds} episodes, got {len(answer.episodes)} and {len(answer.cut)} marks of cut ones"
        for episode in answer.episodes:
            if why := wrong_episode(episode, self._run, self.plan.most_steps):
                return f"episode: {why}"
        opponents, _ = self._matches(answer.ticket)
        if self._run.teams and tuple(episode.opponent for episode in answer.episodes) != opponents:
            return f"expected the opponents {opponents}, got {[episode.opponent for episode in answer.episodes]}"
        return ""


class EvaluationDealer:
    """The evaluations of a run, one after the other."""

    def __init__(self, run: RunSpec) -> None:
        """`run` describes the form of rows and episodes."""
        self.pending: PendingEvaluation | None = None
        self.most_copies: int | None = None
        """limit on the env copies that play, of all workers together (one worker may always play); None for no limit"""
        self._run = run
        self._next_ticket = FIRST_TICKET
        self._late: set[int] = set()  # sessions of workers whose ticket a second worker answered first

    def begin(self, plan: EvaluationPlan, version: int, on_rows: OnRows | None = None, *, beside: bool = False) -> None:
        """Begin to evaluate this version, alongside training if `beside`. Then call `deal` to give out the tickets."""
        assert self.pending is None, "an evaluation is pending"
        self.pending = PendingEvaluation(
            plan,
            version,
            self._run,
            first=self._next_ticket,
            most_copies=self.most_copies,
            late=self._late,
            on_rows=on_rows,
            beside=beside,
        )
        self._next_ticket += len(self.pending.seeds)

    def end(self) -> list[PlayedEpisode]:
        """End the pending evaluation.

        Returns its episodes in the order of the seeds; if it isn't done, only those that have been played.
        """
        ended, self.pending = self.pending, None
        assert ended is not None, "no evaluation is pending"
        for number, members in ended.playing.items():
            for member in members:
                del member.tickets[number]
        return ended.episodes()


def _end(rows: Sequence[EpisodeRows]) -> int:
    """The first step of an episode that these rows don't contain."""
    return rows[-1].first_step + len(rows[-1].reward) if rows else 0
