"""The checks of the collector profile: the client chooses actions with the weights, and sends rollouts.

Each check is a function listed in `profiles.py`, written as `script.py` explains. Its docstring says what the learner does
to the client. In every check, the watch also recomputes what it can of every rollout (`lane_rows.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

import msgpack
import numpy as np
from msgspec.structs import replace

from millrace.extras.conformance.join_checks import (
    POLE_GAINS,
    begins,
    described,
    heartbeats,
    is_gymnasium_pole,
    over_a_new_connection,
    time_limit,
)
from millrace.extras.conformance.learner import QUIET_S, Learner
from millrace.extras.conformance.script import Broken, Ended, Heard, Script, Skipped, Wait, brief
from millrace.extras.conformance.watch import resets_too_early
from millrace.protocol.arrays import Floats
from millrace.protocol.envs.description import agents_in_words
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import UsageError
from millrace.protocol.lane_past import LastEpisode
from millrace.protocol.messages import (
    Collect,
    Drain,
    Evaluate,
    Evaluated,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    LaneIncarnation,
    LanePast,
    Permit,
    Refuse,
    Rejoin,
    Release,
    Rollout,
    Weights,
)
from millrace.protocol.policy.features import leaf_of_features
from millrace.protocol.policy.layout import acting_size, buffer_size, named_views, parameter_layout
from millrace.protocol.rules import Rule
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.plain_values import pack
from millrace.protocol.wire.weight_dtypes import to_wire_dtype

STEPS = 32  # T, the number of steps of a rollout in most checks
TIMED_STEPS = 200  # T of the rollouts that measure the client's speed
TIMED_ROLLOUTS = 3
LONG_S = 1.0  # duration of a long rollout
LONGEST_STEPS = 50_000  # largest T of a long rollout
NET = (16, 16)
LONG_NET = (256, 256)  # net for long rollouts: with a small one, a compiled client would take 50,000 steps in milliseconds
EVALUATED_STEPS = 40
APART_ROLLOUTS = 3  # after this many rollouts of each lane, env copies must differ


class Collecting:
    """A session of the collector profile. It makes and sends the messages that checks need."""

    def __init__(self, learner: Learner, run: RunSpec) -> None:
        self.learner = learner
        self.run = run
        self._sequences = Counter[tuple[int, int]]()  # sequence number of the next permit, by lane and incarnation

    def random_parameters(self, seed: int) -> Floats:
        """Random parameters [P] float32, for a policy that prefers some actions."""
        size = acting_size(self.run.policy)
        return np.random.default_rng(seed).normal(0, 0.3, size).astype(np.float32)

    def weights(
        self, version: int, parameters: Floats | None = None, attributes: Mapping[str, float] | None = None
    ) -> Weights:
        """Weights of this version, with random parameters by default. `attributes`: attributes to set in env copies."""
        chosen = self.random_parameters(version) if parameters is None else parameters
        packed = None if attributes is None else np.frombuffer(pack(attributes), np.uint8)
        return Weights(version, chosen, np.zeros(buffer_size(self.run.policy), np.float32), packed)

    def permit(self, lane: int = 0, incarnation: int = 0) -> Permit:
        """The next permit for this lane. The first one of a higher incarnation makes the client restart all its copies."""
        sequence = self._sequences[lane, incarnation]
        self._sequences[lane, incarnation] += 1
        permit = Permit(next(self.learner.tickets), lane, incarnation, sequence, round=sequence)
        if incarnation and not sequence and self.learner.hello is not None and self.learner.hello.continues:
            return permit.of_new_episodes(self.run.copies)  # a client that doesn't continue lanes restarts its copies anyway
        return permit

    def order(self, *permits: Permit, version: int = 1, keep: Iterable[int] = ()) -> None:
        """Send a Collect, without the weights that it names. `keep`: versions that the client must keep without a ticket."""
        watch = self.learner.watch
        self.learner.send(Collect(self.learner.session, version, permits, watch.received(), watch.to_keep(version, *keep)))

    def give(self, weights: Weights) -> None:
        """Send these weights, unless their version was already sent in this session."""
        if weights.version not in self.learner.watch.versions:
            self.learner.send(weights)

    def deal(self, *permits: Permit, version: int = 1, keep: Iterable[int] = ()) -> None:
        """Send a Collect, and then the weights that it names."""
        self.order(*permits, version=version, keep=keep)
        self.give(self.weights(version))

    @property
    def rollout_s(self) -> float:
        """How long the client takes for a rollout, in a session begun by `collecting_at_length`."""
        return self.learner.step_s * self.run.rollout_steps

    def begin(self, *permits: Permit) -> Script[None]:
        """Deal permits for long rollouts, and wait until the client is collecting the first one."""
        self.deal(*permits)
        yield Wait(self.rollout_s / 5)

    def rollout(self, permit: Permit, rule: Rule | None = None) -> Script[Rollout]:
        """The rollout for a permit that was dealt. Waits until the rollout arrives.

        If it doesn't arrive, raises `Broken` with `rule`, or by default with the rule that was probably broken.
        """
        rule = rule or self.learner.watch.rule_of_missing(permit.ticket, Rule.TICKETS)
        if isinstance(answer := self.learner.watch.answers.get(permit.ticket), Rollout):
            return answer
        text = f"the rollout of ticket {permit.ticket}, lane {permit.lane}, incarnation {permit.incarnation}"
        within_s = 2 * self.learner.settings.patience_s
        return (yield from self.learner.expect(Rollout, rule, text, within_s=within_s, ticket=permit.ticket))

    def collect(self, permit: Permit | None = None, version: int = 1, keep: Iterable[int] = ()) -> Script[Rollout]:
        """Deal this permit (by default, the next one for lane 0), and wait for its rollout."""
        permit = permit or self.permit()
        self.deal(permit, version=version, keep=keep)
        return (yield from self.rollout(permit))

    def nothing_of(self, permit: Permit, rule: Rule, whose: str) -> Script[None]:
        """Check that no rollout for this permit has arrived in this session, and wait a while to see that none arrives."""
        expected = f"no rollout of ticket {permit.ticket}, {whose}"
        if (answer := self.learner.watch.answers.get(permit.ticket)) is not None:
            raise Broken(rule, expected, brief(answer))
        yield from self.learner.quiet(Rollout, rule, expected)


def run_spec(learner: Learner, steps: int = STEPS, **policy_fields: Any) -> Script[RunSpec]:
    """The specification of a run with the client's environment. `policy_fields`: fields of its `PolicySpec`."""
    env = yield from described(learner)
    fields = {"net": NET} | policy_fields
    try:
        policy = PolicySpec(observation_leaves(env.observation_space), action_spec(env.action_space), **fields)
    except UsageError as error:
        raise Broken(Rule.DESCRIBE, "spaces that a policy can use", str(error)) from None
    settings = learner.settings
    return RunSpec(
        env=settings.env,
        policy=policy,
        rollout_steps=steps,
        copies=settings.copies,
        lanes=2,
        seed=5,
        seats=env.seats,
        takes_turns=env.takes_turns,
        heartbeat_s=settings.heartbeat_s,
        learner_timeout_s=30.0,
    )


def collecting(learner: Learner, steps: int = STEPS, **policy_fields: Any) -> Script[Collecting]:
    """Begin a new session of the collector profile."""
    run = yield from run_spec(learner, steps, **policy_fields)
    yield from learner.joining()
    learner.welcome(run)
    return Collecting(learner, run)


def begins_in_its_session(learner: Learner) -> Script[None]:
    """Let the client wait for the run, then begin the run in the same session."""
    run = yield from run_spec(learner)
    yield from begins(learner, run)
    yield from Collecting(learner, run).collect()


def collecting_at_length(learner: Learner, lasts_s: float = LONG_S) -> Script[Collecting]:
    """Begin a session with long rollouts, so that something can happen while the client is collecting one."""
    if not learner.step_s:
        session = yield from collecting(learner, TIMED_STEPS, net=LONG_NET)
        yield from session.collect()  # this rollout isn't measured, because it opens the lane
        took_s = []
        for _ in range(TIMED_ROLLOUTS):
            began_s = learner.now
            yield from session.collect()
            took_s.append(learner.now - began_s)
        learner.step_s = max(min(took_s), 1e-3) / TIMED_STEPS  # the fastest counts, because other programs may slow some
    return (yield from collecting(learner, min(max(int(lasts_s / learner.step_s), STEPS), LONGEST_STEPS), net=LONG_NET))


# ------------------------------------------------------------------------------------------------------------- rollouts


def acts_as_its_policy_says(learner: Learner) -> Script[None]:
    """Collect with ReLU layers. Then collect with normalized observations, many of which are large and thus clipped."""
    relu = yield from collecting(learner, activation="relu")
    permit = relu.permit()
    relu.deal(permit)
    yield from _rollout_or_declined(learner, permit)
    session = yield from collecting(learner, normalize_observations=True)
    permit = session.permit()
    session.order(permit)
    policy = session.run.policy
    drawn = np.random.default_rng(1)
    of_boxes = np.array([leaf.kind == "box" for leaf in leaf_of_features(policy)])
    mean = np.where(of_boxes, drawn.normal(0, 0.05, of_boxes.size), 0)
    std = np.where(of_boxes, drawn.choice([0.003, 0.3], of_boxes.size), 1)
    session.give(replace(session.weights(1), buffers=np.concatenate([mean, std]).astype(np.float32)))
    yield from _rollout_or_declined(learner, permit)


def _rollout_or_declined(learner: Learner, permit: Permit) -> Script[None]:
    text = f"the rollout of ticket {permit.ticket}"
    within_s = 2 * learner.settings.patience_s
    yield from learner.takes_part(Rollout, Rule.TICKETS, text, within_s=within_s)


def sets_attributes(learner: Learner) -> Script[None]:
    """Send attributes with weights: version 1 turns the cart's force off, 2 sets none, and 3 turns the force on again."""
    env = yield from described(learner)
    if not is_gymnasium_pole(env):
        raise Skipped("the environment is not gymnasium's CartPole")
    session = yield from collecting(learner)
    plan: Any = ({"force_mag": 0.0, "gravity": 0.0}, False), (None, False), ({"force_mag": 9.0}, True)
    for version, (attributes, pushed) in enumerate(plan, 1):
        permit = session.permit()
        session.order(permit, version=version)
        session.give(session.weights(version, attributes=attributes))
        rollout = yield from session.rollout(permit)
        speed = rollout.obs[0][..., 1]
        change = np.abs(np.diff(speed, axis=0))[rollout.valid].max(initial=0.0)
        if (change > 0.05) != pushed:
            forces = attributes or "as before"
            expected = f"a cart that is {'pushed' if pushed else 'not pushed'} under version {version}: {forces}"
            raise Broken(Rule.ATTRIBUTES, expected, f"its speed changes by up to {change:.3f} in a step")


def collects(learner: Learner) -> Script[None]:
    """Collect rollouts of one lane, one after the other."""
    session = yield from collecting(learner)
    for _ in range(4):
        yield from session.collect()


def _repeats(one: Rollout, other: Rollout) -> bool:
    """Whether all observations and actions of two rollouts are identical."""
    return all(a.tobytes() == b.tobytes() for a, b in zip((*one.obs, one.action), (*other.obs, other.action), strict=True))


def keeps_rows(learner: Learner) -> Script[None]:
    """Collect short rollouts until enough episodes have ended, some of them in the last row of a rollout."""
    session = yield from collecting(learner, steps=7)
    ends = 0
    between = False  # whether an episode ended in the last row of a rollout
    around: list[tuple[bytes, bytes]] = []  # pairs: last observation of an episode, first observation of the next
    for _ in range(40):
        rollout = yield from session.collect()
        if ends >= 8 and len(around) >= 3 and between:
            break
        ends += len(rollout.episodes)
        resets = np.repeat(rollout.steps_that_reset, session.run.seats_of_copy, axis=1)
        between = between or bool(resets[-1].any())
        for t, n in np.argwhere(rollout.terminated[:-1] & resets[1:-1]):
            last, first = (b"".join(leaf[row, n].tobytes() for leaf in rollout.obs) for row in (t + 1, t + 2))
            around.append((last, first))
    if not ends:
        raise Skipped(f"no episode ended in {40 * 7} steps")
    if resets_too_early(around):
        raise Broken(
            Rule.LAST_OBSERVATION,
            "the last observation of an episode in obs[t+1] of the row that ends it",
            f"the first one of the next episode, at each of {len(around)} ends",
        )


def declines_other_agents(learner: Learner) -> Script[None]:
    """Begin a run with agents that the environment doesn't have."""
    run = yield from run_spec(learner)
    run = replace(run, seats=() if run.seats else ("one", "other"), takes_turns=False)
    yield from learner.joining()
    learner.welcome(run)
    session = Collecting(learner, run)
    session.deal(session.permit())
    text = f"Goodbye with the reason, in a run of {agents_in_words(run.seats, run.takes_turns)}"
    yield from learner.expect((Goodbye, Failure), Rule.OTHER_AGENTS, text, within_s=_long(learner))
    yield from _ends(learner, (1, 2), "its last words")


def truncates_at_the_limit(learner: Learner) -> Script[None]:
    """Collect with the weights of a good policy, so that episodes reach the time limit."""
    longest = yield from time_limit(learner)
    session = yield from collecting(learner, steps=longest + 10)
    reached = False
    for _ in range(2):
        permit = session.permit()
        session.order(permit)
        session.give(session.weights(1, _balancing(session)))
        rollout = yield from session.rollout(permit)
        for episode in rollout.episodes:
            if episode.length > longest:
                raise Broken(Rule.TRUNCATED, f"episodes of at most {longest} steps, as described", f"{episode.length} steps")
            reached |= episode.length == longest
        lengths = np.array([episode.length for episode in rollout.episodes])
        flags = _truncated_in_order(rollout)
        if (early := flags & (lengths < longest)).any():
            raise Broken(Rule.TRUNCATED, f"truncated after {longest} steps only", f"after {lengths[early][0]} steps")
    if not reached:
        raise Skipped("no episode reached the time limit")


def _truncated_in_order(rollout: Rollout) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """For each episode of the rollout, whether only a time limit ended it; False for all if there are several agents."""
    if rollout.resets is not None:
        return np.zeros(len(rollout.episodes), bool)
    ended = (rollout.terminated | rollout.truncated) & rollout.valid
    return np.asarray((rollout.truncated & ~rollout.terminated)[ended])


def _balancing(session: Collecting) -> Floats:
    """Parameters of an almost linear network that balances CartPole's pole; for other environments, random parameters."""
    policy = session.run.policy
    if [leaf.shape for leaf in policy.observation] != [(4,)] or policy.action.sizes != (2,):
        return session.random_parameters(1)
    flat = np.zeros(acting_size(policy), np.float32)
    views = [view for view in named_views(flat, parameter_layout(policy)[0]).values() if view.ndim == 2]
    first, second, out = views
    first[0] = 0.1 * np.array(POLE_GAINS, np.float32)
    second[0, 0] = 1.0
    out[:, 0] = (-2000.0, 2000.0)
    return flat


def waits_for_weights(learner: Learner) -> Script[None]:
    """Deal a permit whose weights haven't been sent yet, while the client has older ones."""
    session = yield from collecting(learner)
    yield from session.collect()
    permit = session.permit()
    session.order(permit, version=2, keep=(1,))
    text = f"no rollout of ticket {permit.ticket} before the Weights of version 2"
    yield from learner.quiet(Rollout, Rule.VERSION, text)
    session.give(session.weights(2))
    yield from session.rollout(permit, Rule.VERSION)


def acts_under_the_named_version(learner: Learner) -> Script[None]:
    """Send newer weights first, as if the weights named in a permit had been lost. The watch compares versions."""
    session = yield from collecting(learner)
    older = session.permit()
    newer = session.permit()
    session.order(older, version=3)
    session.give(session.weights(5))
    text = f"no rollout of ticket {older.ticket} before the Weights of version 3, which it names"
    yield from learner.quiet(Rollout, Rule.VERSION, text)
    session.give(session.weights(3))
    yield from session.rollout(older, Rule.VERSION)
    session.order(newer, version=5)
    yield from session.rollout(newer, Rule.HOLDS_WEIGHTS)


def holds_two_versions(learner: Learner) -> Script[None]:
    """Deal two permits of one lane under two versions, and send the weights of the second one first."""
    session = yield from collecting(learner)
    first = session.permit()
    second = session.permit()
    session.order(first, version=1)
    session.deal(second, version=2)
    session.give(session.weights(1))
    for permit in (first, second):
        yield from session.rollout(permit, Rule.HOLDS_WEIGHTS)


def collects_in_order(learner: Learner) -> Script[None]:
    """Send the Collect of a later rollout first, as if the Collect of the next rollout had been lost."""
    session = yield from collecting(learner)
    yield from session.collect()
    lost = session.permit()
    later = session.permit()
    session.deal(later)
    text = f"no rollout of sequence {later.sequence} before that of sequence {lost.sequence}"
    yield from learner.quiet(Rollout, Rule.IN_ORDER, text)
    session.deal(lost)
    for permit in (lost, later):
        yield from session.rollout(permit, Rule.IN_ORDER)


def lists_what_it_holds(learner: Learner) -> Script[None]:
    """Make permits wait by not sending the first one's weights. Heartbeats must list versions and tickets meanwhile."""
    session = yield from collecting(learner)
    session.order(session.permit(), version=1)
    for version in (2, 3):
        session.deal(session.permit(), version=version)
    text = "a Heartbeat with versions 2 and 3, which have come and which tickets name"
    yield from learner.expect(Heartbeat, Rule.HEARTBEAT_VERSIONS, text, versions=(2, 3))
    yield from heartbeats(learner, 4)


def keeps_listed_weights(learner: Learner) -> Script[None]:
    """Collect under three versions. The second order lists the first version as one to keep; the third doesn't."""
    session = yield from collecting(learner)
    yield from session.collect(version=1)
    for version, kept in ((2, (1, 2)), (3, (3,))):
        yield from session.collect(version=version, keep=kept)
        beat = yield from heartbeats(learner, 2)
        if beat.versions != kept:
            expected = f"{list(kept)}, which the last order listed: no ticket is left"
            raise Broken(Rule.HOLDS_WEIGHTS, expected, f"{list(beat.versions)}")


def keeps_its_weights(learner: Learner) -> Script[None]:
    """Send new weights while the client collects a rollout. The watch checks log_prob with the rollout's own weights."""
    session = yield from collecting_at_length(learner)
    permit = session.permit()
    session.deal(permit)
    for version in range(2, 20):  # these weights are sent without their orders, as if the orders had been lost
        session.give(session.weights(version))
        yield Wait(session.rollout_s / 10)
    yield from session.rollout(permit)
    yield from session.collect(version=version)


def takes_rounded_weights(learner: Learner) -> Script[None]:
    """Send parameters that are rounded to bfloat16, as an array of uint16."""
    session = yield from collecting(learner)
    rounded = to_wire_dtype(session.random_parameters(1), "bfloat16")
    permit = session.permit()
    session.order(permit, version=1)
    session.give(Weights(1, rounded, np.zeros(buffer_size(session.run.policy), np.float32)))
    yield from session.rollout(permit)


def sends_again(learner: Learner) -> Script[None]:
    """Ask for the same ticket again, as if its rollout had been lost."""
    session = yield from collecting(learner)
    learner.watch.confirms = False
    permit = session.permit()
    yield from session.collect(permit)
    for _ in range(2):
        session.deal(permit)
        yield from learner.expect(
            Rollout, Rule.ROLLOUT_ONCE, f"the rollout of ticket {permit.ticket} again", ticket=permit.ticket
        )
    yield from session.collect()


def forgets_what_arrived(learner: Learner) -> Script[None]:
    """Send a late copy of a Collect whose rollout has arrived."""
    session = yield from collecting(learner)
    permit = session.permit()
    yield from session.collect(permit)
    yield from heartbeats(learner, 2)
    session.deal(permit)
    yield from learner.quiet(Rollout, Rule.RECEIVED, f"no rollout of ticket {permit.ticket} after it was received")
    yield from session.collect()


def says_no_rollout_twice(learner: Learner) -> Script[None]:
    """After a rollout, request nothing more, and don't confirm that the rollout has arrived."""
    session = yield from collecting(learner)
    learner.watch.confirms = False
    permit = session.permit()
    yield from session.collect(permit)
    yield from learner.quiet(Rollout, Rule.ROLLOUT_ONCE, "one rollout of a ticket that was dealt once", for_s=1.0)


def collects_two_lanes(learner: Learner) -> Script[None]:
    """Deal several permits of each of two lanes in one Collect, under weights that make all actions equally probable.

    The copies must differ in their actions and in their first observations.
    """
    session = yield from collecting(learner)
    permits = [session.permit(lane) for _ in range(APART_ROLLOUTS) for lane in (0, 1)]
    session.order(*permits)
    session.give(session.weights(1, np.zeros_like(session.random_parameters(1))))
    rollouts: list[Rollout] = []
    for permit in permits:
        rollout = yield from session.rollout(permit)
        rollouts.append(rollout)
    copies = [
        (f"copy {n} of lane {lane}", *_did(rollouts[lane::2], n, session.run.seats_of_copy))
        for lane in (0, 1)
        for n in range(session.run.copies)
    ]
    for (one, actions, firsts), (other, its_actions, its_firsts) in combinations(copies, 2):
        drawn = [(a, b) for a, b in zip(actions, its_actions, strict=True) if a and b]
        if len(drawn) >= STEPS and all(a == b for a, b in drawn):
            raise Broken(
                Rule.INDEPENDENT, "copies that draw their own actions", f"those of {one} in {other}, {len(drawn)} times"
            )
        starts = list(zip(firsts, its_firsts, strict=False))
        if len(starts) >= 2 and len(set(firsts)) > 1 and all(a == b for a, b in starts):
            got = f"those of {one} in {other}, {len(starts)} times"
            raise Broken(Rule.INDEPENDENT, "copies whose episodes begin in their own way", got)


def _did(rollouts: Sequence[Rollout], n: int, seats: int) -> tuple[list[bytes], list[bytes]]:
    """The actions of copy `n`'s first seat, and the first observations of its episodes, as bytes.

    An action is empty in rows that aren't valid.
    """
    actions = list[bytes]()
    first = n * seats
    firsts = [b"".join(leaf[0, first].tobytes() for leaf in rollouts[0].obs)]
    for rollout in rollouts:
        for t, resets in enumerate(rollout.steps_that_reset[:-1, n]):
            actions.append(rollout.action[t, first].tobytes() if rollout.valid[t, first] else b"")
            if resets:
                firsts.append(b"".join(leaf[t + 1, first].tobytes() for leaf in rollout.obs))
    return actions, firsts


def starts_a_lane_again(learner: Learner) -> Script[None]:
    """Deal a permit of a higher incarnation, then one of a lower incarnation."""
    session = yield from collecting(learner)
    before = yield from session.collect()
    permit = session.permit(incarnation=2)
    if learner.hello is not None and learner.hello.continues:  # tell the client that this isn't the first incarnation
        permit = replace(permit, past=LanePast.unknown(0, session.run.copies))
    after = yield from session.collect(permit)
    if _repeats(before, after):
        got = f"the same observations and actions as in incarnation 0, for {STEPS} steps"
        raise Broken(Rule.INDEPENDENT, "other episodes in incarnation 2", got)
    session.permit(incarnation=1)
    old = session.permit(incarnation=1)  # has the next sequence number
    session.deal(old)
    yield from learner.quiet(Rollout, Rule.INCARNATION, "no rollout of incarnation 1 after one of 2")
    yield from session.collect(session.permit(incarnation=2))


def _past_of(rollouts: Sequence[Rollout]) -> LanePast:
    """The history of lane 0 after these rollouts, which must be all of the lane's rollouts."""
    last = rollouts[-1]
    resets = np.concatenate([*(each.steps_that_reset[:-1] for each in rollouts), last.steps_that_reset[-1:]])
    K = len(resets) - 1
    copies = []
    for begun in {each.copy: each for rollout in rollouts for each in rollout.begun}.values():
        of_copy = resets[:, begun.copy]
        over = bool(of_copy[K])
        first = K if over else 1 + int(max(np.flatnonzero(of_copy), default=-1))
        copies.append((begun.copy, LastEpisode(begun.start, begun.random, first, over, steps=K - first)))
    mask = () if last.mask is None else (last.mask,)
    return replace(
        LanePast.unknown(0, len(copies)),
        copies=tuple(episode for _, episode in sorted(copies, key=lambda each: each[0])),
        action=np.concatenate([each.action for each in rollouts]),
        obs=tuple(leaf[-1] for leaf in (*last.obs, *mask)),
        memory=last.memory,
    )


def continues_a_lane(learner: Learner) -> Script[None]:
    """Send the client a lane's history, as if another worker had collected it. In the next incarnation, the client must
    continue the lane bit for bit as that worker would have.
    """
    rounds = 3
    undisturbed = yield from collecting(learner, steps=7)
    if learner.hello is None or not learner.hello.continues:
        raise Skipped("the client does not say that it continues lanes")
    before = []
    for _ in range(rounds):
        rollout = yield from undisturbed.collect()
        before.append(rollout)
    expected = yield from undisturbed.collect()
    session = yield from collecting(learner, steps=7)
    collected = []
    for earlier in before:
        rollout = yield from session.collect()
        if not rollout.memory:
            raise Broken(Rule.PAST, "memory in each rollout of a client that continues lanes", "none")
        if not _repeats(earlier, rollout):
            raise Skipped("the environment isn't deterministic")
        collected.append(rollout)
    past = _past_of(collected)
    if past.new_episodes:
        raise Skipped("the episodes of the environment cannot be repeated")
    found = yield from session.collect(replace(session.permit(incarnation=1), round=rounds, past=past))
    if not _repeats(expected, found):
        raise Broken(Rule.PAST, "the observations and actions that follow the past of the lane", "others")


def releases_a_lane(learner: Learner) -> Script[None]:
    """Release a lane while one of its tickets waits for weights, as if the lane were moving to another worker."""
    session = yield from collecting(learner)
    yield from session.collect(session.permit(0))
    lost = session.permit(0)
    kept = session.permit(1)
    session.order(lost, kept, version=2)
    learner.send(Release(learner.session, (LaneIncarnation(0, 0),)))
    session.give(session.weights(2))
    yield from session.rollout(kept)
    yield from session.nothing_of(lost, Rule.RELEASE, "whose lane was released")
    heartbeat = yield from heartbeats(learner, 1)
    if lost.ticket in heartbeat.tickets:
        raise Broken(Rule.RELEASE, "no tickets of the released lane in a Heartbeat", f"ticket {lost.ticket}")
    yield from session.collect(session.permit(0, incarnation=1), version=2)


def closes_unlisted_lanes(learner: Learner) -> Script[None]:
    """Send no Release, as if it had been lost, and don't list the lane in the next HeartbeatReply."""
    session = yield from collecting(learner)
    lost = session.permit(0)
    kept = session.permit(1)
    session.order(lost, kept, version=2)
    learner.watch.sent(Release(learner.session, (LaneIncarnation(0, 0),)))  # only recorded, not sent, as if it had been lost
    yield from heartbeats(learner, 3)
    session.give(session.weights(2))
    yield from session.rollout(kept)
    yield from session.nothing_of(lost, Rule.UNLISTED, "whose lane is not listed")


def ignores_a_late_reply(learner: Learner) -> Script[None]:
    """Send late copies of old HeartbeatReplies, which don't list a lane that was first dealt after those replies."""
    session = yield from collecting(learner)
    learner.answers_heartbeats = False
    yield from heartbeats(learner, 1)
    early = [learner.watch.reply(6), learner.watch.reply(2)]
    learner.send(early[0])
    permit = session.permit()
    session.order(permit, version=2)
    for late in early:
        learner.send(late)
    yield Wait(0.3)
    session.give(session.weights(2))
    learner.answers_heartbeats = True
    text = f"the rollout of ticket {permit.ticket}: late copies of replies 6 and 2 close no lane"
    yield from learner.expect(Rollout, Rule.LATE_REPLY, text, ticket=permit.ticket)


# --------------------------------------------------------------------------------------------------------------- faults


def forgets_the_session_before(learner: Learner) -> Script[None]:
    """Send Rejoin during a rollout. The client must send nothing more from the old session, and forget its weights."""
    session = yield from collecting_at_length(learner)
    yield from session.begin(session.permit(0), session.permit(1))
    again = yield from collecting(learner, net=LONG_NET)
    permit = again.permit()
    again.order(permit)
    text = "no rollout before the first Weights of the session"
    yield from learner.quiet(Rollout, Rule.FORGETS, text, for_s=2 * QUIET_S)
    again.give(again.weights(1))
    yield from again.rollout(permit)


def collects_over_a_new_connection(learner: Learner) -> Script[None]:
    """Cut the connection during a rollout, and ask for the ticket again."""
    session = yield from collecting_at_length(learner)
    permit = session.permit()
    yield from session.begin(permit)
    yield from over_a_new_connection(learner, Rollout)
    if permit.ticket not in learner.watch.answers:
        session.order(permit)
        learner.send(session.weights(1))
        yield from session.rollout(permit)
    yield from session.collect()


def ignores_what_it_cannot_read(learner: Learner) -> Script[None]:
    """Send a Collect with an extra or missing field, Weights with a missing frame, and a Collect for another session."""
    session = yield from collecting(learner)
    yield from session.collect()
    permit = session.permit()
    head = msgpack.unpackb(bytes(encode(Collect(learner.session, 1, (permit,), learner.watch.received(), (1,)))[0]))
    learner.send_unreadable(
        permit.ticket,
        [msgpack.packb([*head, "one field too many"])],
        [msgpack.packb(head[:-1])],
        [encode(session.weights(9))[0]],
    )
    of_other = replace(permit, ticket=next(learner.tickets))
    learner.send(Collect(learner.session + 1000, 1, (of_other,), (), (1,)))
    text = "no rollout for a Collect with a field too many or too few, or of another session"
    yield from learner.quiet(Rollout, Rule.IGNORE_UNREADABLE, text)
    yield from session.collect(replace(permit, ticket=next(learner.tickets)))


def beats_while_it_collects(learner: Learner) -> Script[None]:
    """Collect rollouts without a pause. Meanwhile, the watch checks that heartbeats arrive."""
    session = yield from collecting(learner, steps=1000)
    until_s = learner.now + 2 * 1.5 + 8 * learner.settings.heartbeat_s
    while learner.now < until_s:
        yield from session.collect()


def evaluates(learner: Learner) -> Script[None]:
    """Evaluate two greedy episodes, then again with a low step limit. Repeat the second order, as if its answer was lost.

    The watch compares the two answers.
    """
    session = yield from collecting(learner)
    yield from _evaluate(session, _evaluation(learner))
    order = _evaluation(learner, most_steps=2)
    yield from _evaluate(session, order)
    learner.send(order)
    yield from learner.expect(
        Evaluated, Rule.EVALUATE_ONCE, f"Evaluated for ticket {order.ticket} again", ticket=order.ticket
    )


def evaluates_one_version(learner: Learner) -> Script[None]:
    """Order an evaluation whose weights haven't been sent yet, while the client has older ones."""
    session = yield from collecting(learner)
    yield from session.collect()
    order = _evaluation(learner, version=2)
    learner.send(order)
    text = f"no Evaluated for ticket {order.ticket} before version 2"
    yield from learner.quiet(Evaluated, Rule.EVALUATE_VERSION, text)
    session.give(session.weights(2))
    yield from learner.expect(Evaluated, Rule.EVALUATE, f"Evaluated for ticket {order.ticket}", within_s=_long(learner))


def evaluates_with_rows(learner: Learner) -> Script[None]:
    """Evaluate episodes and ask for their rows. A client may decline.

    The orders vary: sampled or greedy actions, the same seeds in another order, episodes that are cut or run to their end.
    The watch recomputes what it can of each answer.
    """
    session = yield from collecting(learner)
    order = _evaluation(learner, greedy=False, send_rows=True, seeds=(1, 2, 3, 4))
    learner.send(order)
    session.give(session.weights(1, np.zeros_like(session.random_parameters(1))))
    yield from learner.takes_part(Evaluated, Rule.EVALUATE, f"Evaluated for ticket {order.ticket}", within_s=_long(learner))
    order = _evaluation(learner, version=2, send_rows=True)
    answer = yield from _evaluate(session, order)
    swapped = _evaluation(learner, version=2, send_rows=True, seeds=order.seeds[::-1])
    yield from _evaluate(session, swapped)
    one, other = (learner.watch.played[each.ticket] for each in (order, swapped))
    if any(one.first_observation(n) != other.first_observation(1 - n) for n in (0, 1)):
        expected = f"the same first observations for the seeds {order.seeds} and {swapped.seeds}, in their order"
        raise Broken(Rule.EVALUATE_SEEDS, expected, "others")
    whole = answer.episodes[0].length
    for most in (whole - 1, whole):
        again = _evaluation(learner, version=2, send_rows=True, most_steps=max(1, most), seeds=order.seeds[:1])
        rows = yield from _evaluate(session, again)
        is_cut = most < whole or answer.cut[0]
        if (rows.episodes[0].length, rows.cut[0]) != (again.most_steps, is_cut):
            expected = f"{again.most_steps} steps and cut {is_cut}: with more steps the same episode has {whole}"
            raise Broken(Rule.CUT, expected, f"{rows.episodes[0].length} steps and cut {rows.cut[0]}")


def evaluates_under_no_other_version(learner: Learner) -> Script[None]:
    """Send newer weights before those of an evaluation. From the rows, the watch sees which weights the evaluation used."""
    session = yield from collecting(learner)
    session.give(session.weights(2, -session.random_parameters(1)))
    order = _evaluation(learner, send_rows=True)
    learner.send(order)
    session.give(session.weights(1))
    yield from learner.takes_part(
        Evaluated, Rule.EVALUATE_VERSION, f"Evaluated for ticket {order.ticket}", within_s=_long(learner)
    )


def ends_evaluations(learner: Learner) -> Script[None]:
    """Order an evaluation whose weights are never sent, then another one, which must end the first one.

    The second order names an older version than the first, which must make no difference.
    """
    session = yield from collecting(learner)
    over = _evaluation(learner, version=3)
    order = _evaluation(learner, version=2)
    learner.send(over)
    yield from _evaluate(session, order)
    heartbeat = yield from heartbeats(learner, 1)
    if over.ticket in heartbeat.tickets:
        got = f"ticket {over.ticket}"
        raise Broken(Rule.EVALUATE_ENDS, "no ticket of version 3 in a Heartbeat, after an Evaluate of version 2", got)
    session.give(session.weights(3))
    text = f"no Evaluated for ticket {over.ticket}, which ticket {order.ticket} has ended"
    yield from learner.quiet(Evaluated, Rule.EVALUATE_ENDS, text)


def _long(learner: Learner) -> float:
    return 2 * learner.settings.patience_s


def _evaluation(
    learner: Learner,
    *,
    version: int = 1,
    greedy: bool = True,
    most_steps: int = EVALUATED_STEPS,
    send_rows: bool = False,
    seeds: tuple[int, ...] = (1, 2),
) -> Evaluate:
    kept = learner.watch.to_keep(version)
    ticket = next(learner.tickets)
    return Evaluate(learner.session, ticket, version, seeds, greedy, most_steps, send_rows, False, keep=kept)


def _evaluate(session: Collecting, order: Evaluate) -> Script[Evaluated]:
    """Order an evaluation, send its weights, and wait for the answer, which the watch checks."""
    session.learner.send(order)
    session.give(session.weights(order.version))
    text = f"Evaluated for ticket {order.ticket}"
    return (
        yield from session.learner.expect(
            Evaluated, Rule.EVALUATE, text, within_s=_long(session.learner), ticket=order.ticket
        )
    )


def drains_while_it_collects(learner: Learner) -> Script[None]:
    """Send Drain while the client collects the rollout of one ticket and another ticket waits. Heartbeats must continue."""
    session = yield from collecting_at_length(learner, 3 * LONG_S)
    permits = [session.permit(), session.permit()]
    yield from session.begin(*permits)
    waits = session.permit(1)
    session.order(waits, version=9)
    learner.send(Drain("the run is over"))
    early = set(learner.watch.answers)
    drained_s = learner.now
    beat_s = learner.settings.heartbeat_s
    within_s = 2 * learner.settings.patience_s
    text = "Goodbye after Drain"
    goodbye = yield from learner.expect((Rollout, Goodbye), Rule.DRAIN, text, within_s=within_s)
    finished_s = learner.now
    if not isinstance(goodbye, Goodbye):
        goodbye = yield from learner.expect(Goodbye, Rule.DRAIN, text, within_s=within_s)
    if learner.watch.heard_heartbeat_s < drained_s + beat_s and finished_s > drained_s + 3 * beat_s:
        got = f"none in {finished_s - drained_s:.1f} s between Drain and the end of its rollout"
        raise Broken(Rule.HEARTBEAT, f"a Heartbeat every {beat_s:g} s while it finishes its rollout", got)
    arrived = learner.watch.answers.keys()
    unfinished = {permit.ticket for permit in (*permits, waits)} - arrived
    if (listed := set(goodbye.tickets)) != unfinished:
        raise Broken(Rule.DRAIN, f"Goodbye with the unfinished tickets {sorted(unfinished)}", f"{sorted(listed)}")
    if (late := len(arrived - early)) > 1:
        raise Broken(Rule.DRAIN, "no new rollout after Drain: at most the one in progress", f"{late} rollouts")
    yield from learner.left(Rule.DRAIN, "Drain and Goodbye")


def _draining(learner: Learner) -> Script[Collecting]:
    """Begin a session, and send Drain during a rollout."""
    session = yield from collecting_at_length(learner)
    yield from session.begin(session.permit())
    learner.send(Drain("the run is over"))
    return session


def takes_no_work_while_it_drains(learner: Learner) -> Script[None]:
    """Send a Collect after Drain."""
    session = yield from _draining(learner)
    late = session.permit(1)
    session.order(late)
    within_s = 2 * learner.settings.patience_s
    goodbye = yield from learner.expect(Goodbye, Rule.DRAIN, "Goodbye after Drain", within_s=within_s)
    if late.ticket in learner.watch.answers or late.ticket in goodbye.tickets:
        got = "its rollout" if late.ticket in learner.watch.answers else "that ticket in Goodbye"
        raise Broken(Rule.DRAINING_IGNORES, f"nothing of ticket {late.ticket}, which came after Drain", got)
    yield from learner.left(Rule.DRAIN, "Drain and Goodbye")


def leaves_when_refused_while_it_drains(learner: Learner) -> Script[None]:
    """Send Refuse after Drain. The client may have left already."""
    yield from _draining(learner)
    learner.send(Refuse("the test refuses this worker"))
    yield from _ends(learner, (0, 2), "Drain and Refuse")


def leaves_when_unknown_while_it_drains(learner: Learner) -> Script[None]:
    """Send Rejoin after Drain, as if the learner no longer knew the session."""
    yield from _draining(learner)
    learner.send(Rejoin(learner.session))
    yield from _ends(learner, (0, 1), "Drain and Rejoin")


def _ends(learner: Learner, codes: tuple[int, ...], after: str) -> Script[None]:
    """Wait until the client ends, perhaps after a Goodbye. Raises `Broken` unless it ends with one of these exit codes."""
    within_s = 2 * learner.settings.patience_s
    learner.may_leave = True  # so that this check, and not the learner, judges a Hello
    before = learner.hello
    assert before is not None
    last_event = yield Wait(within_s, lambda event: isinstance(event, Ended) or isinstance(event.message, Goodbye | Hello))
    match last_event:
        case Ended(code) if code in codes:
            return
        case Ended(code):
            raise Broken(Rule.DRAINING_LEAVES, f"exit code {codes[0]} or {codes[1]} after {after}", f"exit code {code}")
        case Heard(_, Hello(process_nonce=nonce)) if nonce != before.process_nonce:
            return
        case Heard(_, Goodbye()):
            yield from learner.left(Rule.DRAINING_LEAVES, after, codes)
        case _:
            got = "Hello" if last_event is not None else f"a client that still runs {within_s:g} s later"
            raise Broken(Rule.DRAINING_LEAVES, f"the client's end after {after}", got)
