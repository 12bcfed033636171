"""Serves the learner's metrics to Prometheus at `/metrics`. Their names follow Prometheus's conventions.

Rule: at intervals, the training loop publishes a complete snapshot in one assignment. It never waits. The server's threads
read only the newest snapshot. Labels have few values: millrace's own, and at most `MAX_FACTS` names of `info_keys`, but
never names of workers, paths or keys.

Rule: counters count only what this learner process did. A resumed run continues from a checkpoint whose counts may be lower
than those that Prometheus has seen, and Prometheus would take a falling counter for one that restarted at 0.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from typing import NamedTuple
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
    SummaryMetricFamily,
)
from prometheus_client.registry import Collector

from millrace import Progress
from millrace.learner.config.config import Config
from millrace.learner.rollouts.hub import Hub
from millrace.learner.run_folder.results import FactMean
from millrace.learner.run_folder.run_format import versions
from millrace.protocol.address import WILDCARDS, is_local
from millrace.protocol.bounds import MAX_FACTS
from millrace.protocol.errors import UsageError

log = logging.getLogger("millrace.learner")

EVERY_S = 0.5  # minimum time between two snapshots
SCRAPE_TIMEOUT_S = 5.0  # if a scraper sends nothing for longer, its connection is closed, and its thread ends
LAGS = (0, 1, 2, 4, 8, 16, 32)
"""upper bounds of the histogram's buckets, in versions"""
STAGES = {"learner": ("wait", "update", "evaluate", "other"), "worker": ("wait", "open", "act", "step", "evaluate")}
TICKET_ENDS = ("used", "lost")
TRANSITION_ENDS = ("used", "duplicate", "late", "invalid")
STATES = ("active", "spare", "evaluating", "draining")


class Observed(NamedTuple):
    """A snapshot of the hub. It never changes afterwards."""

    at_s: float
    """its time, in seconds since 1970"""
    progress: Progress
    """the progress that was last reported"""
    ledger: Mapping[str, int]
    """all counts of the hub's ledger"""
    version: int = -1
    """version of the newest weights; -1 before the first"""
    roles: Mapping[str, int] = {}
    """number of workers by their `Member.role`"""
    lags: Mapping[int, int] = {}
    """number of rollouts used since this learner started, by lag"""
    received: tuple[int, int] = (0, 0)
    """number of messages received, and their total bytes"""
    sent: tuple[int, int] = (0, 0)
    """number of messages sent, and their total bytes"""
    refused_messages: int = 0
    """number of messages that were refused because their sender's key was revoked"""
    refused_handshakes: int = 0
    """number of handshakes that failed"""

    @classmethod
    def of(cls, hub: Hub, at_s: float) -> Observed:
        """A snapshot taken now."""
        link = hub.link
        coordinator = hub.coordinator
        return cls(
            at_s=at_s,
            progress=hub.reported,
            ledger=coordinator.rollouts.ledger.counts(),
            version=coordinator.version,
            roles=Counter(member.role for member in coordinator.members.values()),
            lags=dict(hub.lag_statistics.lags),
            received=(link.received.messages, link.received.bytes),
            sent=(link.sent.messages, link.sent.bytes),
            refused_messages=link.refused_messages,
            refused_handshakes=link.refused,
        )


class MetricsCollector(Collector):
    """Keeps the newest snapshot and turns it into metrics."""

    def __init__(self, config: Config, clock: Callable[[], float] = time.time, observed: Observed | None = None) -> None:
        """`clock`: seconds since 1970. `observed`: the snapshot to show before the first call to `observe`."""
        self._clock = clock
        self._observed = observed
        self._before: Observed | None = None  # the first snapshot: what the run had counted before this learner resumed it
        self._about = {"env": config.env, "algo": config.algo, "seed": str(config.seed)}
        self._wanted = config.lanes

    def observe(self, hub: Hub) -> None:
        """Take a new snapshot if the last one is old enough. The hub calls this whenever it has listened for messages."""
        now = self._clock()
        if self._observed is not None and 0.0 <= now - self._observed.at_s < EVERY_S:
            return
        observed = Observed.of(hub, now)
        if self._before is None:
            self._before = observed
        self._observed = observed

    def describe(self) -> Iterator[Metric]:
        """Describe nothing in advance, because otherwise the registry would collect metrics at registration."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """All metrics. A thread of the server calls this once for each scrape."""
        yield InfoMetricFamily("millrace_build", "Versions of millrace and of what decides its results.", versions())
        yield InfoMetricFamily("millrace_run", "What is trained.", self._about)
        # Reported even before the first worker has joined, because an autoscaler may need this number to start one.
        wanted = "Workers with which each lane has its own: the number to scale to."
        yield GaugeMetricFamily("millrace_workers_wanted", wanted, self._wanted)
        if (now := self._observed) is not None:
            yield GaugeMetricFamily("millrace_loop_timestamp_seconds", "When the learner's loop last listened.", now.at_s)
            before = self._before or now
            counted = _since(before.ledger, now.ledger)
            yield from _of_progress(now, before.progress)
            yield from _of_ledger(now.ledger, counted)
            yield from _of_workers(now)
            yield from _of_link(now, counted)


def _since(before: Mapping[str, float], now: Mapping[str, float]) -> dict[str, float]:
    """What was counted since `before`, by name."""
    return {name: max(0.0, number - before.get(name, 0.0)) for name, number in now.items()}


def _of_progress(now: Observed, before: Progress) -> Iterator[Metric]:
    done = now.progress
    stage_s = _since(before.stages, done.stages)
    steps = done.env_steps - before.env_steps
    yield CounterMetricFamily("millrace_env_steps", "Env steps that updates of this learner have used.", steps)
    yield GaugeMetricFamily(
        "millrace_run_env_steps", "Env steps that updates have used since the run began.", done.env_steps
    )
    yield GaugeMetricFamily("millrace_target_env_steps", "Env steps to train for.", done.total_steps)
    yield GaugeMetricFamily("millrace_env_steps_per_second", "Mean since this learner began.", done.steps_per_s)
    yield GaugeMetricFamily("millrace_weights_version", "Updates that made the newest weights; -1 before any.", now.version)
    if done.return_mean is not None and done.length_mean is not None:
        yield GaugeMetricFamily(
            "millrace_episode_return_mean", "Of the last 100 training episodes, raw rewards.", done.return_mean
        )
        yield GaugeMetricFamily(
            "millrace_episode_length_mean", "Env steps, of the last 100 training episodes.", done.length_mean
        )
    yield from _of_facts(done.facts)
    yield SummaryMetricFamily(
        "millrace_update_seconds",
        "Updates by this learner and the time they took.",
        count_value=done.updates - before.updates,
        sum_value=stage_s.get("learner_update", 0.0),
    )
    stages = CounterMetricFamily(
        "millrace_stage_seconds", "Time in each stage: of the learner, of all workers together.", labels=("side", "stage")
    )
    for side, names in STAGES.items():
        for name in names:
            stages.add_metric((side, name), stage_s.get(f"{side}_{name}", 0.0))
    yield stages


def _of_facts(facts: Mapping[str, FactMean]) -> Iterator[Metric]:
    """The numbers that `info_keys` names. A name is the value of a label and may be any text, because labels are escaped."""
    means = GaugeMetricFamily(
        "millrace_episode_info_mean",
        "Numbers in info, by name: of those of the last 100 training episodes that have it.",
        labels=("key",),
    )
    missing = GaugeMetricFamily(
        "millrace_episode_info_missing",
        "How many of the last 100 training episodes do not have the number, by name.",
        labels=("key",),
    )
    for name, fact in islice(facts.items(), MAX_FACTS):
        if fact.mean is not None:
            means.add_metric((name,), fact.mean)
        missing.add_metric((name,), fact.missing)
    yield from (means, missing) if facts else ()


def _of_ledger(ledger: Mapping[str, int], counted: Mapping[str, float]) -> Iterator[Metric]:
    """`counted`: the counts of this learner alone."""
    yield CounterMetricFamily("millrace_tickets_issued", "Tickets dealt by this learner.", counted["issued"])
    yield _by_reason("millrace_tickets", "Tickets by how they ended.", {name: counted[name] for name in TICKET_ENDS})
    yield GaugeMetricFamily("millrace_tickets_outstanding", "Tickets neither used nor given up.", ledger["outstanding"])
    yield CounterMetricFamily(
        "millrace_transitions_received", "Transitions that reached this learner.", counted["transitions_received"]
    )
    ends = {name: counted[f"transitions_{name}"] for name in TRANSITION_ENDS}
    yield _by_reason("millrace_transitions", "Transitions by how they ended.", ends)
    yield GaugeMetricFamily("millrace_transitions_waiting", "Transitions not yet used.", ledger["transitions_waiting"])


def _of_workers(now: Observed) -> Iterator[Metric]:
    workers = GaugeMetricFamily("millrace_workers", "Workers by state; a spare one has no lane.", labels=("state",))
    for state in STATES:
        workers.add_metric((state,), now.roles.get(state, 0))
    yield workers
    lags = now.lags
    upto = [sum(count for lag, count in lags.items() if lag <= bound) for bound in LAGS]
    buckets = [*((str(bound), count) for bound, count in zip(LAGS, upto, strict=True)), ("+Inf", sum(lags.values()))]
    yield HistogramMetricFamily(
        "millrace_rollout_lag_versions",
        "Rollouts that updates used, by how many versions old their weights were.",
        buckets=buckets,
        sum_value=sum(lag * count for lag, count in lags.items()),
    )


def _of_link(now: Observed, counted: Mapping[str, float]) -> Iterator[Metric]:
    for name, (messages, size) in (("received", now.received), ("sent", now.sent)):
        yield CounterMetricFamily(f"millrace_{name}_messages", f"Messages {name} by this learner.", messages)
        yield CounterMetricFamily(f"millrace_{name}_bytes", f"Bytes of the messages {name}.", size)
    refused = {"unreadable": counted["messages_bad"], "key": now.refused_messages}
    yield _by_reason("millrace_refused_messages", "Messages that were not used, by reason.", refused)
    late = "Actions that arrived too late for a program that owns its loop."
    yield CounterMetricFamily("millrace_late_actions", late, counted["late_actions"])
    yield CounterMetricFamily("millrace_refused_handshakes", "Connections that were not let in.", now.refused_handshakes)


def _by_reason(name: str, text: str, counts: Mapping[str, float]) -> CounterMetricFamily:
    family = CounterMetricFamily(name, text, labels=("reason",))
    for reason, count in counts.items():
        family.add_metric((reason,), count)
    return family


# ---------------------------------------------------------------------------------------------------------- the server


@contextmanager
def metrics_server(config: Config) -> Iterator[Callable[[Hub], None]]:
    """A context manager that serves `/metrics` at `metrics_bind`, and yields the observer that the hub must call.

    Raises `UsageError`, with a one-line message, if it can't listen there.
    """
    collector = MetricsCollector(config)
    registry = CollectorRegistry()
    registry.register(collector)
    ProcessCollector(registry=registry)
    with _served(config.metrics_bind, registry):
        yield collector.observe


@contextmanager
def _served(bind: str, registry: CollectorRegistry) -> Iterator[None]:
    named, _, port = bind.rpartition(":")
    host = "" if named in WILDCARDS and ":" not in named else named.strip("[]")
    try:
        kind = _IPv6 if ":" in host else _Server
        server = make_server(host, 0 if port == "*" else int(port), make_wsgi_app(registry), kind, _Quiet)
    except OSError as error:
        why = error.strerror or str(error)
        raise UsageError(f"metrics_bind {bind}: cannot listen there ({why}); choose another port, or '' for none") from error
    thread = threading.Thread(target=server.serve_forever, name="metrics", kwargs={"poll_interval": 0.1}, daemon=True)
    thread.start()
    try:
        where = f"metrics at http://{named}:{server.server_port}/metrics"
        if is_local(f"tcp://{bind}"):
            log.info("%s", where)
        else:
            log.warning(
                "%s can be read by anyone who can reach that port: they show what is trained and how far it is", where
            )
        yield
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class _Server(ThreadingWSGIServer):
    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore scrapers that hang up or send nothing."""


class _IPv6(_Server):
    address_family = socket.AF_INET6


class _Quiet(WSGIRequestHandler):
    """A request handler that logs no line for a scrape."""

    timeout = SCRAPE_TIMEOUT_S

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""
