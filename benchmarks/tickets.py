"""Draws docs/images/tickets.png, which shows when workers collect rollouts and when the learner updates the policy.

`python -m benchmarks.tickets` runs the real coordinator (`learner/rollouts/ticket_coordinator.py`) in simulated time. There
are three lanes, each on a worker of its own. The rollouts of a lane differ in duration (`ROLLOUT_S`), an update takes as
long as a short rollout, and messages take no time. The picture therefore shows only the effect of the rule for tickets, and
is the same on every machine.
"""

from __future__ import annotations

import argparse
import heapq
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from benchmarks.simulated import canned, run_spec
from benchmarks.writing import COLORS, DPI, GREY
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.messages import PROTOCOL_VERSION, Collect, Hello

OUT = Path(__file__).parents[1] / "docs" / "images" / "tickets.png"
LANES = 3
ROLLOUT_S = (1.0, 1.6, 1.1, 2.0)  # durations of successive rollouts, in a cycle; lane n begins with the n-th one
UPDATE_S = 1.0
NOTHING = np.zeros(0, np.float32)


class Span(NamedTuple):
    """The time of a rollout or an update in the picture."""

    row: int
    """number of the lane; `LANES` is the learner"""
    start_s: float
    end_s: float
    version: int
    """version of the weights with which the rollout was collected, or with which the update began"""


class Played(NamedTuple):
    """The result of a simulation."""

    spans: list[Span]
    lags: list[int]
    """the lag of each rollout that an update used"""


def play(max_lag: int, seconds: float) -> Played:
    """Simulate workers and learner with this `max_lag`."""
    run = run_spec(LANES)
    rollout = canned(run)
    coordinator = TicketCoordinator(run, RolloutDealer(run.lanes, Rounds(max_lag)), worker_timeout_s=1e9, first_session=1)
    spans: list[Span] = []
    lags: list[int] = []
    events: list[tuple[float, int]] = []  # time at which a rollout or update ends, and its row
    tickets: list[list[tuple[int, int]]] = [[] for _ in range(LANES)]  # for each lane: ticket and version of the weights
    busy = [False] * (LANES + 1)
    collected = [0] * LANES
    now = 0.0

    def dealt(out: list[tuple[bytes, object]]) -> None:
        for _, message in out:
            if isinstance(message, Collect):
                for permit in message.permits:
                    tickets[permit.lane].append((permit.ticket, message.version))

    def publish(version: int) -> None:
        coordinator.publish(version, NOTHING, NOTHING)
        dealt(list(coordinator.begin_update()))

    def begin(row: int, duration_s: float, version: int) -> None:
        busy[row] = True
        spans.append(Span(row, now, now + duration_s, version))
        heapq.heappush(events, (now + duration_s, row))

    peers = [f"w{n}".encode() for n in range(LANES)]
    for n, peer in enumerate(peers):
        coordinator.receive(peer, Hello(PROTOCOL_VERSION, peer.decode(), "host", n + 1, n, "simulated", n + 1), now)
    publish(0)
    while now < seconds:
        if not busy[LANES] and (taken := coordinator.rollouts.take()):
            lags += [coordinator.version - each.rollout.version for each in taken]
            begin(LANES, UPDATE_S, coordinator.version)
        for lane in range(LANES):
            if tickets[lane] and not busy[lane]:
                begin(lane, ROLLOUT_S[(lane + collected[lane]) % len(ROLLOUT_S)], tickets[lane][0][1])
        now, row = heapq.heappop(events)
        busy[row] = False
        if row == LANES:
            publish(coordinator.version + 1)
            continue
        owner = coordinator.rollouts.lanes[row].owner
        assert owner is not None
        ticket, version = tickets[row].pop(0)
        filled = msgspec.structs.replace(
            rollout,
            session=coordinator.members[owner].session,
            lane=row,
            ticket=ticket,
            version=version,
            sequence=collected[row],
        )
        collected[row] += 1
        dealt(list(coordinator.receive(owner, filled, now)))
    return Played(spans, lags)


def busy_share(played: Played, rows: range, seconds: float) -> float:
    """The share of the time in which these rows collect or learn."""
    began = [span for span in played.spans if span.row in rows and span.start_s < seconds]
    return sum(min(span.end_s, seconds) - span.start_s for span in began) / (seconds * len(rows))


def draw(out: Path, seconds: float = 20.0) -> None:
    """Draw a panel for each of `max_lag` 0, 1 and 2, with a row for each lane and for the learner."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(10.0, 5.6), layout=ConstrainedLayoutEngine())
    panels = figure.subplots(3, 1, sharex=True)
    for max_lag, panel in enumerate(panels):
        played = play(max_lag, seconds)
        for span in played.spans:
            panel.broken_barh(
                [(span.start_s, span.end_s - span.start_s)],
                (span.row + 0.08, 0.84),
                color=COLORS[span.version % len(COLORS)],
                edgecolor="white",
                linewidth=1.0,
            )
            if (span.start_s + span.end_s) / 2 < seconds:
                middle = (span.start_s + span.end_s) / 2, span.row + 0.5
                panel.text(*middle, str(span.version), ha="center", va="center", fontsize=7, color="white")
        collects, learns = (busy_share(played, rows, seconds) for rows in (range(LANES), range(LANES, LANES + 1)))
        panel.set_title(
            f"max_lag {max_lag}: workers collect {collects:.0%} of the time, the learner learns {learns:.0%}; "
            f"lags {min(played.lags)} to {max(played.lags)}",
            fontsize=9,
            fontweight="bold",
            loc="left",
        )
        panel.set_xlim(0, seconds)
        panel.set_ylim(LANES + 1, 0)
        panel.set_yticks([row + 0.5 for row in range(LANES + 1)], [*(f"lane {n}" for n in range(LANES)), "update"])
        panel.tick_params(labelsize=8, colors=GREY, length=2)
        for side in ("top", "right", "left"):
            panel.spines[side].set_visible(False)
    panels[-1].set_xlabel("time; the number is the version of the weights; white: it waits", fontsize=8, color=GREY)
    figure.savefig(out, dpi=DPI)


def main() -> None:
    parser = argparse.ArgumentParser(description="draw when lanes are collected and when the learner learns")
    parser.add_argument("--out", type=Path, default=OUT, help="PNG to write")
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
