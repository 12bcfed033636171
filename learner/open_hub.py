"""Creates a run's hub from its settings, for millrace's training and for your own loop.

It imports no torch. This file doesn't know who starts worker processes: the launchers in `millrace` pass in a
`WorkerProcesses`, along with the lobby.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import asdict

from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.rollouts.hub import Hub, HubObserver, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lane_history import LaneHistories
from millrace.learner.rollouts.opponent_pool import OpponentPool
from millrace.learner.rollouts.past_rollouts import PastRollouts
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.progress import RunProgress
from millrace.protocol.specs import RunSpec, WaitSpec

NO_PROGRESS = RunProgress()


def open_hub(
    config: RolloutConfig,
    run: RunSpec,
    lobby: Lobby,
    check_interrupt: Callable[[], None],
    observer: HubObserver = lambda hub: None,
    past: PastRollouts | None = None,
    opponents: OpponentPool | None = None,
) -> Hub:
    """Open the hub of a run, which takes over the lobby's workers and serves workers that join later.

    An update uses one rollout from each lane. `check_interrupt` is called while the hub waits, and an exception that it
    raises ends the wait. `observer` is called each time the hub has listened. In a resumed run, `past` comes from the
    checkpoint. In a run with teams, `opponents` is the pool of opponents.
    """
    past = past or PastRollouts()
    rounds = Rounds(config.max_lag, past.rounds.next, past.rounds.versions)
    histories = LaneHistories(run.copies, config.most_repeated_steps(), past.lanes)
    rollouts = RolloutDealer(run.lanes, rounds, past.ledger, past.incarnations, opponents, histories)
    coordinator = TicketCoordinator(
        run, rollouts, worker_timeout_s=config.worker_timeout_s, first_session=lobby.first_session
    )
    for weights in past.acting:
        coordinator.keep(weights)
    limits = [most for most in (config.max_env_copies, lobby.processes.most_copies) if most]
    if limits:
        coordinator.evaluation.most_copies = min(limits) - run.lanes * run.copies
    settings = HubSettings(
        config.no_workers_timeout_s,
        config.stall_timeout_s(),
        config.max_env_failures,
        config.acting_dtype,
    )
    hub = Hub(lobby.link, coordinator, settings, lobby.processes, check_interrupt, observer)
    hub.take_over(lobby.hand_over(), lobby.described_in_s)
    return hub


def lobby_settings(config: RolloutConfig, progress: RunProgress = NO_PROGRESS) -> LobbySettings:
    """The settings that matter before the run begins. In a resumed run, `progress` says how far the run has got."""
    return LobbySettings(
        wait=WaitSpec(**asdict(config.terms())),
        worker_timeout_s=config.worker_timeout_s,
        no_workers_timeout_s=config.no_workers_timeout_s,
        stall_timeout_s=config.stall_timeout_s(),
        max_env_failures=config.max_env_failures,
        progress=progress,
        launched_workers=config.launched_workers,
    )
