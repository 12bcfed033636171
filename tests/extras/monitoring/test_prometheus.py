"""What Prometheus reads: the coordinator's and the ledger's own numbers, well formed, and there only when asked for."""

from __future__ import annotations

import itertools
import logging
import shutil
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
import zmq
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from millrace.extras.monitoring import prometheus
from millrace.extras.monitoring.metric_names import METRICS
from millrace.extras.monitoring.prometheus import EVERY_S, STAGES, MetricsCollector, metrics_server
from millrace.launch import training
from millrace.learner.config.config import Config
from millrace.learner.config.layers import resolve
from millrace.learner.rollouts.hub import PULSE_S, Hub, HubSettings
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import FactMean
from millrace.learner.run_setup import prometheus_observer
from millrace.protocol.bounds import MAX_FACTS, Stage
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import Drain
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.workers.collect.collector import Collector
from tests.learner.rollouts.test_ticket_coordinator import A, B, C, Learner
from tests.support.conversation.fake_ends import process_ends, run_spec

Labels = tuple[tuple[str, str], ...]
Metrics = dict[tuple[str, Labels], float]

PROGRESS = Progress(
    env_steps=1_000, total_steps=10_000, updates=7, steps_per_s=50.0, return_mean=12.5, length_mean=9.0,
    stages={"learner_wait": 3.0, "learner_update": 1.5, "worker_step": 2.0, "worker_my-secret": 9.0},
)  # fmt: skip


def parsed(text: str) -> Metrics:
    found: Metrics = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            assert family.documentation
            found[sample.name, tuple(sorted(sample.labels.items()))] = sample.value
    return found


class Scraped:
    """A learner's hub that a test works by hand, and an exposition that looks at it; the clock is a number."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], lanes: int = 2) -> None:
        self.learner = Learner(lanes, publish=False)
        self.link = LearnerLink("inproc://exposition", context)
        self.now = 1_000.0
        self.exposition = MetricsCollector(Config(env="CartPole-v1"), lambda: self.now)
        asked = itertools.count()
        self.hub = Hub(
            self.link, self.learner.coordinator,
            HubSettings(no_workers_timeout_s=60, stall_timeout_s=60, max_env_failures=0),
            observer=self.exposition.observe, clock=lambda: 2 * PULSE_S * next(asked),
        )  # fmt: skip

    def text(self) -> str:
        registry = CollectorRegistry()
        registry.register(self.exposition)
        return generate_latest(registry).decode()

    def metrics(self) -> Metrics:
        self.now += EVERY_S
        self.hub.pulse()
        return parsed(self.text())


@pytest.fixture
def scraped() -> Iterator[Scraped]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    made = Scraped(context)
    yield made
    made.link.close(0)
    context.term()


def by(found: Metrics, name: str, label: str) -> dict[str, float]:
    return {dict(labels)[label]: value for (known, labels), value in found.items() if known == name}


def test_before_the_learner_has_begun_it_tells_what_it_is_and_how_many_workers_it_wants(scraped: Scraped) -> None:
    """An autoscaler starts the first worker, without which nothing begins."""
    found = parsed(scraped.text())
    assert {name for name, _ in found} == {"millrace_build_info", "millrace_run_info", "millrace_workers_wanted"}
    assert found["millrace_workers_wanted", ()] == Config(env="CartPole-v1").lanes
    ((_, labels),) = [key for key in found if key[0] == "millrace_run_info"]
    assert dict(labels) == {"env": "CartPole-v1", "algo": "ppo", "seed": "1"}


def test_the_numbers_are_those_of_the_coordinator_and_the_ledger(scraped: Scraped) -> None:
    learning, hub = scraped.learner, scraped.hub
    scraped.metrics()
    for name in (A, B, C):
        learning.joins(name)
    learning.publish(0)
    learning.deliver_all()
    assert learning.coordinator.rollouts.take()
    hub.lag_statistics.used([0, 0, 3])
    learning.publish(1)
    process_ends(learning.coordinator, "a", "was killed")
    learning.coordinator.reject_message(B, "rubbish", 0.0)
    found = scraped.metrics()
    ledger = learning.coordinator.rollouts.ledger.counts()
    assert ledger["lost"] > 0
    assert by(found, "millrace_tickets_total", "reason") == {name: ledger[name] for name in ("used", "lost")}
    assert found["millrace_tickets_issued_total", ()] == ledger["issued"]
    assert found["millrace_tickets_outstanding", ()] == ledger["outstanding"]
    ended = by(found, "millrace_transitions_total", "reason")
    assert ended == {name: ledger[f"transitions_{name}"] for name in ended}
    assert set(ended) == {"used", "duplicate", "late", "invalid"}
    received = found["millrace_transitions_received_total", ()]
    assert received == ledger["transitions_received"] == sum(ended.values()) + found["millrace_transitions_waiting", ()] > 0
    assert by(found, "millrace_workers", "state") == {"active": 2, "spare": 0, "evaluating": 0, "draining": 0}
    assert by(found, "millrace_refused_messages_total", "reason") == {"unreadable": 1, "key": 0}
    assert found["millrace_weights_version", ()] == 1
    assert by(found, "millrace_rollout_lag_versions_bucket", "le") == {
        "0": 2, "1": 2, "2": 2, "4": 3, "8": 3, "16": 3, "32": 3, "+Inf": 3,
    }  # fmt: skip
    assert (found["millrace_rollout_lag_versions_count", ()], found["millrace_rollout_lag_versions_sum", ()]) == (3, 3)
    learning.coordinator.drain("done")
    assert by(scraped.metrics(), "millrace_workers", "state") == {"active": 0, "spare": 0, "evaluating": 0, "draining": 2}


def test_the_numbers_of_info_keys_are_gauges_whatever_their_names_are(scraped: Scraped) -> None:
    scraped.learner.joins(A)
    scraped.learner.publish(0)
    names = {"is_success", 'the "best"', "C:\\temp\\n", "Güte {a=1}", "millrace_workers"}
    facts = {name: FactMean(mean=0.25 * number, missing=number) for number, name in enumerate(sorted(names))}
    scraped.hub.report_progress(msgspec.structs.replace(PROGRESS, facts=facts | {"never": FactMean(None, 9)}))
    found = scraped.metrics()
    assert by(found, "millrace_episode_info_mean", "key") == {name: fact.mean for name, fact in facts.items()}
    missing = {name: fact.missing for name, fact in facts.items()}
    assert by(found, "millrace_episode_info_missing", "key") == {**missing, "never": 9}
    assert by(found, "millrace_workers", "state").keys() == {"active", "spare", "evaluating", "draining"}


def test_no_more_numbers_of_info_keys_are_shown_than_a_run_may_have(scraped: Scraped) -> None:
    scraped.learner.joins(A)
    scraped.learner.publish(0)
    many = {f"key{number}": FactMean(mean=1.0, missing=0) for number in range(MAX_FACTS + 10)}
    scraped.hub.report_progress(msgspec.structs.replace(PROGRESS, facts=many))
    assert len(by(scraped.metrics(), "millrace_episode_info_mean", "key")) == MAX_FACTS


def test_without_info_keys_there_is_no_such_gauge(scraped: Scraped) -> None:
    scraped.learner.joins(A)
    scraped.learner.publish(0)
    assert "episode_info" not in str(scraped.metrics().keys())


def test_a_worker_without_a_lane_is_a_spare(scraped: Scraped) -> None:
    for name in (A, B, C):
        scraped.learner.joins(name)
    scraped.learner.publish(0)
    assert by(scraped.metrics(), "millrace_workers", "state") == {"active": 2, "spare": 1, "evaluating": 0, "draining": 0}


def test_progress_is_that_of_the_last_update_and_updates_are_this_learners_own(scraped: Scraped) -> None:
    scraped.hub.report_progress(Progress(updates=5))  # of a run that is resumed
    before = scraped.metrics()
    assert "millrace_episode_return_mean" not in {name for name, _ in before}  # not 0: no episode has ended
    assert before["millrace_update_seconds_count", ()] == 0
    scraped.hub.report_progress(PROGRESS)
    found = scraped.metrics()
    assert (found["millrace_update_seconds_count", ()], found["millrace_update_seconds_sum", ()]) == (2, 1.5)
    assert found["millrace_env_steps_total", ()] == 1_000
    assert found["millrace_target_env_steps", ()] == 10_000
    assert found["millrace_env_steps_per_second", ()] == 50.0
    assert found["millrace_episode_return_mean", ()] == 12.5
    assert found["millrace_stage_seconds_total", (("side", "learner"), ("stage", "wait"))] == 3.0
    assert found["millrace_stage_seconds_total", (("side", "worker"), ("stage", "step"))] == 2.0
    assert found["millrace_loop_timestamp_seconds", ()] == scraped.now


def test_counters_begin_at_zero_when_a_run_is_resumed(scraped: Scraped) -> None:
    """The checkpoint may know fewer steps than were scraped, and Prometheus would count the smaller number as new steps."""
    scraped.hub.report_progress(msgspec.structs.replace(PROGRESS, env_steps=700, stages={"learner_wait": 2.0}))
    scraped.learner.coordinator.rollouts.ledger.transitions_received = 800
    before = scraped.metrics()
    assert before["millrace_env_steps_total", ()] == before["millrace_transitions_received_total", ()] == 0
    scraped.hub.report_progress(PROGRESS)
    found = scraped.metrics()
    assert (found["millrace_env_steps_total", ()], found["millrace_run_env_steps", ()]) == (300, 1_000)
    assert found["millrace_stage_seconds_total", (("side", "learner"), ("stage", "wait"))] == 1.0


def test_what_workers_call_themselves_and_their_stages_is_no_label(scraped: Scraped) -> None:
    scraped.learner.joins(b"my-secret")
    scraped.hub.report_progress(PROGRESS)
    scraped.metrics()
    assert "my-secret" not in scraped.text()


def test_the_stages_are_those_that_workers_and_the_learner_have() -> None:
    run = run_spec()
    assert {*Collector(run, make_policy(run.policy)).stages, "wait", "evaluate"} == set(STAGES["worker"])
    assert set(STAGES["worker"]) == set(get_args(Stage))
    logged = {name.removeprefix("stage/learner_") for group in METRICS.values() for name in group if "/learner_" in name}
    assert logged == set(STAGES["learner"])


def test_a_snapshot_is_taken_now_and_then_and_a_scrape_takes_none(scraped: Scraped) -> None:
    scraped.metrics()
    before = scraped.text()
    scraped.learner.joins(A)
    assert scraped.text() == before
    scraped.hub.pulse()
    assert scraped.text() == before, "the clock stood still"
    scraped.now -= 3_600.0  # it was set back
    scraped.hub.pulse()
    assert scraped.text() != before


def test_bytes_are_counted_where_they_pass(scraped: Scraped) -> None:
    said, answer = encode(Drain("done")), encode(Drain("no"))
    dealer = scraped.link.context.socket(zmq.DEALER)
    dealer.routing_id = b"a"
    dealer.connect("inproc://exposition")
    dealer.send_multipart([*said, b"xyz"])
    assert scraped.link.poll(10.0)
    assert len(list(scraped.link.receive())) == 1
    assert scraped.link.send(b"a", answer)
    assert not scraped.link.send(b"nobody", answer)
    dealer.close(0)
    found = scraped.metrics()
    assert found["millrace_received_bytes_total", ()] == 1 + sum(map(len, said)) + 3
    assert found["millrace_sent_bytes_total", ()] == 1 + sum(map(len, answer))
    assert (found["millrace_received_messages_total", ()], found["millrace_sent_messages_total", ()]) == (1, 1)


# ---------------------------------------------------------------------------------------------- over HTTP, in a run

RUN: dict[str, Any] = {
    "transport": "inproc",
    "steps": 512,
    "envs": 2,
    "lanes": 2,
    "rollout_steps": 32,
    "eval_episodes": 1,
    "workers": 1,
}


def get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10.0) as answer:
        assert answer.headers.get_content_type() == "text/plain"
        return str(answer.read().decode())


def test_it_is_scraped_while_a_run_goes_on_and_is_gone_with_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prometheus, "EVERY_S", 0.0)
    caplog.set_level(logging.INFO, "millrace.learner")
    scrapes: list[Metrics] = []
    urls: list[str] = []

    def watch(progress: Progress) -> None:
        if not urls:
            urls.extend(line.split()[2] for line in caplog.messages if line.startswith("metrics at "))
        scrapes.append(parsed(get(urls[0])))

    run = training.train(resolve("CartPole-v1", run_dir=str(tmp_path), metrics_bind="127.0.0.1:*", **RUN), None, watch)
    assert run.is_dir()
    assert len(scrapes) >= 512 / 64
    assert [by(found, "millrace_workers", "state")["active"] for found in (scrapes[0], scrapes[-1])] == [1, 0]
    steps = [found["millrace_env_steps_total", ()] for found in scrapes]
    assert steps == sorted(steps)
    assert "process_resident_memory_bytes" in {name for name, _ in scrapes[-1]}
    assert not [thread for thread in threading.enumerate() if thread.name == "metrics"]
    with pytest.raises(OSError):
        get(urls[0])


def test_it_is_off_unless_asked_for(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "millrace.learner")
    with prometheus_observer(Config(env="CartPole-v1")):
        assert not [thread for thread in threading.enumerate() if thread.name == "metrics"]
    assert not caplog.messages


def test_a_run_that_breaks_leaves_no_server_behind() -> None:
    with pytest.raises(RuntimeError, match="broke"), metrics_server(Config(env="CartPole-v1", metrics_bind="127.0.0.1:*")):
        raise RuntimeError("it broke")
    assert not [thread for thread in threading.enumerate() if thread.name == "metrics"]


def test_what_others_can_reach_is_said_to_be_open(caplog: pytest.LogCaptureFixture) -> None:
    with metrics_server(Config(env="CartPole-v1", metrics_bind="0.0.0.0:*")):
        pass
    (line,) = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert "can be read by anyone who can reach that port" in line


def test_a_port_in_use_is_one_line_and_no_run_folder_is_made(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        bind = f"127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(
            UsageError, match=rf"metrics_bind {bind}: cannot listen there \(Address already in use\)"
        ) as found:
            training.train(
                resolve("CartPole-v1", run_dir=str(tmp_path / "runs"), metrics_bind=bind, **RUN), None, lambda _: None
            )
    assert found.value.exit_code == 2
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("bind", ["9464", "127.0.0.1", "127.0.0.1:99999", "http://127.0.0.1:9464"])
def test_where_to_listen_is_checked_before_anything_begins(bind: str) -> None:
    with pytest.raises(UsageError, match=r"metrics_bind .*: expected HOST:PORT, as in 127\.0\.0\.1:9464"):
        resolve("CartPole-v1", metrics_bind=bind)


def test_prometheus_own_linter_finds_nothing(scraped: Scraped) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed (Debian: apt-get install prometheus)")
    scraped.hub.report_progress(PROGRESS)
    scraped.metrics()
    done = subprocess.run(
        [promtool, "check", "metrics"], input=scraped.text(), capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_it_needs_no_torch() -> None:
    asks = "import sys, millrace.extras.monitoring.prometheus; assert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", asks], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
