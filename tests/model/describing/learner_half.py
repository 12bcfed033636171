"""The learner of a run that begins with a description: a real `DescribeCoordinator`, then the learner of a training run.

Rules: one worker is asked for the description, and more if one that was asked is lost, as long as any are there; none that
has not answered an earlier order, while another one is free; every worker that waits is taken over in its session, and has
no lanes before it has begun the run if it was asked for a description; and unless something goes wrong, none is told to join
again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gymnasium import spaces

from millrace.learner.members.describe_coordinator import FIRST_TICKET, DescribeCoordinator, Unknown
from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.messages import Describe, Rejoin, WorkerExit
from millrace.protocol.rules import Rule
from tests.model import learner_part, membership_part
from tests.model.conversation import Content, Event, Facts
from tests.model.learner_part import Learner
from tests.model.message_content import ENV, WAIT, message_of, peer_of, worker_of
from tests.model.settings import TIMEOUT_S
from tests.model.training import learner_event
from tests.support.conversation.fake_ends import any_rows

if TYPE_CHECKING:
    from tests.model.describing.describing import Describing

SAVED = {"membership", "described", "_at_once", "_tickets"}
"""What of `DescribeCoordinator` is saved."""
NOT_SAVED = {"worker_timeout_s", "unsuitable", "_unknown", "_decliners_to_end", "_decliners"}
"""All environments are alike, and nobody declines."""
DESCRIBED = DescribedEnv(spaces.Discrete(2), spaces.Discrete(2))


def start(settings: Describing) -> Content:
    """A learner that has started, without members."""
    return _saved(_lobby(0, 1), settings, 0.0), None


def facts(content: Content, settings: Describing) -> Facts:
    """Those of a learner whose run has not begun."""
    described, _, asked, members = content[0]
    return Facts(
        updating=described and asked == settings.environments, members=tuple(member[0].value for member in members[0])
    )


def event(
    content: Content, settings: Describing, event: Event, message: Content | None, now: float
) -> tuple[Content, list[Outgoing]]:
    """The learner after this event, and what it sends."""
    lobby, run = content
    if run is not None:
        learner, out = learner_event(learner_part.loaded(run, settings), event, message, now)
        _check_lanes(learner)
        return (None, learner_part.saved(learner, now)), _checked(out, settings)
    coordinator = _loaded(lobby)
    if event == ("publish",):
        learner, out = _taken_over(coordinator, settings, now)
        _check_lanes(learner)
        return (None, learner_part.saved(learner, now)), _checked(out, settings)
    at_once = coordinator._at_once
    sessions = {member.session for member in coordinator.members.values()}
    out = _in_lobby(coordinator, event, message, now)
    lost = sessions - {member.session for member in coordinator.members.values()}
    assert lost or coordinator._at_once == at_once, f"{Rule.ONE_DESCRIBES}: several workers are asked although none was lost"
    if coordinator.described is not None and _asked(coordinator) < settings.environments:
        out += coordinator.ask(Unknown(ENV))
    _check_who_is_asked(coordinator, out, event)
    asked = sum(coordinator._tickets in member.tickets for member in coordinator.members.values())
    wanted = min(coordinator._at_once, len(coordinator.members))
    assert coordinator.described or asked == wanted, (
        f"{Rule.ONE_DESCRIBES}: {asked} workers are asked to describe, instead of {wanted}"
    )
    return (_saved(coordinator, settings, now), None), _checked(out, settings)


def _check_who_is_asked(coordinator: DescribeCoordinator, out: list[Outgoing], event: Event) -> None:
    """A worker that is busy is asked only if no other one is free, or if its own heartbeat shows that the order was lost."""
    free = any(not member.tickets for member in coordinator.members.values())
    for peer, message in out:
        if isinstance(message, Describe) and event[:2] != ("receive", worker_of(peer)):
            busy = len(coordinator.members[peer].tickets) > 1
            assert not (busy and free), (
                f"{Rule.ONE_DESCRIBES}: a worker that has not answered is asked again, although another one is free"
            )


def _check_lanes(learner: Learner) -> None:
    for member in learner.coordinator.members.values():
        assert not (member.describes and member.lanes), f"{Rule.BEGINS}: a worker that may still describe has lanes"


def _in_lobby(coordinator: DescribeCoordinator, event: Event, message: Content | None, now: float) -> list[Outgoing]:
    match event:
        case "receive", worker, _:
            assert message is not None
            return coordinator.receive(peer_of(worker), message_of(message, worker, WAIT), now)
        case ("time",):
            return coordinator.remove_silent(now)
        case "revoke", worker:
            return coordinator.revoke(peer_of(worker), "its key was revoked")
        case "ended", worker, nonce:
            return coordinator.process_ended(WorkerExit(f"w{worker}", nonce, "killed", True))
    raise AssertionError(event)


def _taken_over(coordinator: DescribeCoordinator, settings: Describing, now: float) -> tuple[Learner, list[Outgoing]]:
    """The hub is made: it has the workers, and no weights yet."""
    made = TicketCoordinator(
        settings.run,
        RolloutDealer(settings.run.lanes, Rounds(settings.max_lag)),
        worker_timeout_s=TIMEOUT_S,
        first_session=0,
        check_rows=any_rows,
    )
    sessions = {peer: member.session for peer, member in coordinator.members.items()}
    unanswered = {peer for peer, member in coordinator.members.items() if member.tickets}
    out = made.take_over(coordinator.membership, now)
    assert {peer: member.session for peer, member in made.members.items()} == sessions, (
        f"{Rule.BEGINS}: a worker has lost its session"
    )
    assert {peer for peer, member in made.members.items() if member.describes} == unanswered, (
        f"{Rule.BEGINS}: the run does not know who may still describe"
    )
    learner = Learner(settings, made)
    learner.updating = True
    return learner, out


def _checked(out: list[Outgoing], settings: Describing) -> list[Outgoing]:
    if not settings.faults:
        assert not any(isinstance(message, Rejoin) for _, message in out), f"{Rule.BEGINS}: a worker is told to join again"
    return out


# -------------------------------------------------------------------- to tuples and back


def _lobby(first_session: int, asked: int) -> DescribeCoordinator:
    """One without members that has asked for this number of environments."""
    coordinator = DescribeCoordinator(WAIT, first_session, worker_timeout_s=TIMEOUT_S, decliners_to_end=0)
    for _ in range(asked):
        coordinator.ask(Unknown(ENV))
    assert _asked(coordinator) == asked
    return coordinator


def _asked(coordinator: DescribeCoordinator) -> int:
    """For how many environments it has asked."""
    return coordinator._tickets - FIRST_TICKET


def _saved(coordinator: DescribeCoordinator, settings: Describing, now: float) -> Content:
    at_once = min(coordinator._at_once, settings.workers)  # more are never there
    members = membership_part.saved(coordinator.membership, now)
    return coordinator.described is not None, at_once, _asked(coordinator), members


def _loaded(content: Content) -> DescribeCoordinator:
    described, at_once, asked, members = content
    coordinator = _lobby(members[1].value, asked)
    coordinator._at_once = at_once
    coordinator.described = DESCRIBED if described else None
    membership_part.load(coordinator.membership, members)
    return coordinator
