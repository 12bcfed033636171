"""What holds of a learner's tickets after every event, whatever happened: of rollouts, lanes, members and evaluations."""

from __future__ import annotations

from collections import Counter

from millrace.learner.rollouts.evaluation_dealer import FIRST_TICKET, HELD_AT_ONCE, PendingEvaluation
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.rules import Rule


def waiting_rollouts(coordinator: TicketCoordinator) -> list[AcceptedRollout]:
    """Those that have come and were not taken."""
    return [arrived for of_round in coordinator.rollouts.ready.values() for arrived in of_round.values()]


def check_ledger(coordinator: TicketCoordinator) -> None:
    """Each ticket and each transition is in one place."""
    rollouts, waiting = coordinator.rollouts, waiting_rollouts(coordinator)
    assert rollouts.ledger.outstanding == len(rollouts.held) + len(waiting), "the ledger does not balance"
    waiting_steps = sum(arrived.rollout.env_steps for arrived in waiting)
    assert rollouts.ledger.transitions_waiting == waiting_steps, "transitions do not balance"


def check_tickets(coordinator: TicketCoordinator, max_lag: int, *, shares: bool = False) -> None:
    """The ledger balances, a lane has one owner, and each ticket is with the owner of its lane."""
    rollouts, members, ledger = coordinator.rollouts, coordinator.members, coordinator.rollouts.ledger
    check_ledger(coordinator)
    assert ledger.outstanding <= len(rollouts.lanes) * (1 + max_lag), (
        f"{Rule.OPEN_ROUNDS}: more tickets than the bound allows"
    )
    owners = sorted((number, member.peer) for member in members.values() for number in member.lanes)
    known = [(lane.number, lane.owner) for lane in rollouts.lanes if lane.owner is not None]
    assert owners == known, f"{Rule.LANE_MOVES}: a lane has two owners, or its owner does not know"
    mine = Counter(each.permit.lane for each in rollouts.held.values())
    assert [mine[lane.number] for lane in rollouts.lanes] == [lane.busy for lane in rollouts.lanes], (
        "a lane does not know how many tickets it has"
    )
    assert all(not lane.due or lane.number in rollouts._to_deal for lane in rollouts.lanes), (
        f"{Rule.LOST_TICKETS}: a lane gets no more tickets"
    )
    for number, each in rollouts.held.items():
        assert number in members[each.peer].tickets, f"{Rule.LOST_TICKETS}: an outstanding ticket is with nobody"
        assert rollouts.lanes[each.permit.lane].owner == each.peer, (
            f"{Rule.LANE_MOVES}: a ticket of a lane that its worker does not own"
        )
    evaluation = coordinator.evaluation.pending
    playing = [] if evaluation is None else [number for number, mine in evaluation.playing.items() for _ in mine]
    held = sorted([*rollouts.held, *playing])
    assert held == sorted(number for member in members.values() for number in member.tickets), (
        f"{Rule.TICKET_NUMBERS}: a ticket has two holders"
    )
    processes = {(member.hello.worker, member.hello.process_nonce): member for member in members.values()}
    assert coordinator.membership._of_process == processes, "the processes are not those of the members"
    for member in members.values():
        assert not (member.lanes and member.hello.evaluates), f"{Rule.EVALUATES}: a worker that only evaluates has a lane"
    check_evaluation(coordinator, shares=shares)


def pending_evaluation(coordinator: TicketCoordinator) -> PendingEvaluation:
    """The evaluation that has begun and not ended."""
    pending = coordinator.evaluation.pending
    assert pending is not None, "no evaluation is pending"
    return pending


def check_evaluation(coordinator: TicketCoordinator, *, shares: bool = False) -> None:
    """While an evaluation is pending, its weights are kept, and each of its tickets is in one place."""
    tickets, members = coordinator.evaluation.pending, coordinator.members
    if tickets is None:
        return
    assert tickets.version in coordinator.weights.kept, "the weights of an evaluation were dropped"
    held = [number - tickets._first for number in tickets.playing]
    every = sorted([*tickets._undealt, *held, *tickets._played])
    assert every == list(range(len(tickets.seeds))), "a ticket of an evaluation is not in one place"
    assert all(len(of_ticket) in (1, 2) for of_ticket in tickets.playing.values()), "a ticket is with nobody, or with three"
    for number, member in [(number, member) for number, of_ticket in tickets.playing.items() for member in of_ticket]:
        assert members.get(member.peer) is member, "a ticket of an evaluation is with a worker that is gone"
        assert number in member.tickets, "a worker does not know its ticket of an evaluation"
    collects = [member for member in tickets.players if not member.hello.evaluates]
    assert shares or not (tickets.beside and collects), "a worker that collects plays an evaluation beside training"
    for member in tickets.players:
        mine = [number for number in member.tickets if number >= FIRST_TICKET]
        assert len(mine) <= HELD_AT_ONCE, "a worker holds too many tickets of an evaluation"
