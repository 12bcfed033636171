"""Makes the hub of a run from its settings, for our training and for a user's own loop. Imports no torch.

Who starts worker processes is not known here: the launchers in `millrace` pass in `WorkerProcesses`, with the lobby.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.rollouts.hub import Hub, HubObserver, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.opponent_pool import OpponentPool
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
    past: tuple[Ledger, Sequence[int]] | None = None,
    opponents: OpponentPool | None = None,
) -> Hub:
    """The hub of a run, for the workers in this lobby, and for those that join later. It takes the lobby's place.

    An update takes one rollout for each lane. `check_interrupt` is called while the hub waits: what it
    raises ends the wait. `observer` is called each time the hub has listened. `past`: the ledger, and the next
    incarnation of each lane, of a run that goes on. `opponents`: those of a run with teams.
    """
    ledger, incarnations = (None, ()) if past is None else past
    rollouts = RolloutDealer(run.lanes, Rounds(config.max_lag), ledger, incarnations, opponents)
    coordinator = TicketCoordinator(
        run, rollouts, worker_timeout_s=config.worker_timeout_s, first_session=lobby.first_session
    )
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
    hub.take_over(lobby.hand_over())
    return hub


def lobby_settings(config: RolloutConfig, progress: RunProgress = NO_PROGRESS) -> LobbySettings:
    """The settings that matter before the run. `progress`: how far it is."""
    return LobbySettings(
        wait=WaitSpec(config.call_timeouts(), config.heartbeat_s()),
        worker_timeout_s=config.worker_timeout_s,
        no_workers_timeout_s=config.no_workers_timeout_s,
        stall_timeout_s=config.stall_timeout_s(),
        max_env_failures=config.max_env_failures,
        progress=progress,
        launched_workers=config.launched_workers,
    )
