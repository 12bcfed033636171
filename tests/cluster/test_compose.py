"""docker/compose.yaml with a real Docker Engine, a real Prometheus and real faults: `make test-cluster`."""

from __future__ import annotations

import json
import logging
import math
import re
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from millrace.learner.run_folder.metrics_log import read_rows
from tests.cluster.compose import BASE, LOOK_EVERY_S, USER, Cluster, Program, prepare, program
from tests.cluster.engine import TOOLS, Engine, why_not
from tests.system.stage.processes import ROOT, wait_for

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(3_600)]

log = logging.getLogger("millrace.cluster")

WORKER_MB = 300  # on a slim base
SHORT = "--steps 4096 --eval-episodes 1"
STEPS = "--steps 10000000 --checkpoint-every-s 2"  # the test says when it is over
TARGET = f"{STEPS} --target-return 475 --eval-episodes 20 --eval-every 5000"
DASHBOARD = ROOT / "docker/grafana/dashboards/millrace.json"
OBSERVE = ("--profile", "observe")
WORKERS = "sum(millrace_workers)"


@pytest.fixture
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    if why := why_not((*TOOLS, "prometheus", "promtool", "git", "debootstrap")):
        pytest.skip(why)
    folder = tmp_path_factory.mktemp("engine")  # the path of a socket must be short
    with Engine(folder) as made:
        prepare(made, folder / "prometheus")
        yield made
    assert not (folder / "data").exists()


@pytest.fixture
def cluster(engine: Engine, tmp_path: Path) -> Iterator[Cluster]:
    if (found := program()) is None:
        pytest.skip("neither docker compose nor docker-compose is installed: make packages")
    made = Cluster(engine, found, tmp_path)
    try:
        yield made
    finally:
        made.compose(*OBSERVE, "down", "--volumes", "--timeout", "5")
        shutil.rmtree(made.folder)


def documented() -> set[str]:
    """The commands of compose that a reader is told to type."""
    text = "\n".join((ROOT / file).read_text() for file in ("README.md", "docs/how-to/docker.md", "docker/compose.yaml"))
    commands = re.findall(r"docker compose [^`#\n]*", text)
    assert len(commands) > 10
    return {command.strip() for command in commands}


def test_it_trains_changes_its_size_and_comes_back(cluster: Cluster) -> None:
    cluster.set_flags(SHORT)
    cluster.compose("up", "--build", within_s=1_800)  # all that it takes; it ends with the run
    assert [state["ExitCode"] for name in ("keys", "learner", "worker") for state in cluster.state(name)] == [0] * 3
    the_images_hold_what_they_need(cluster)

    cluster.set_flags(STEPS)
    cluster.up(3)
    cluster.compose(*OBSERVE, "up", "-d", "--scale", "worker=3")
    cluster.sees(WORKERS, lambda count: count == 3)
    cluster.trains()
    keys = the_keys(cluster)
    for workers in (5, 1, 3):
        cluster.up(workers)
        cluster.sees(WORKERS, lambda count, workers=workers: count == workers)  # type: ignore[misc]
        cluster.trains()
        assert len(cluster.containers("worker")) == workers

    assert the_keys(cluster) == keys, "other keys were made in place of those that were there"
    a_worker_that_is_killed_comes_back(cluster)
    the_learner_that_is_killed_comes_back(cluster)
    the_dashboard_has_data(cluster)
    the_metrics_are_well_formed(cluster)
    every_part_says_that_it_is_well(cluster)
    a_token_that_leaked_lets_nobody_in(cluster)

    cluster.compose("stop")
    assert {state["ExitCode"] for state in cluster.state("learner")} == {130}
    assert {state["ExitCode"] for state in cluster.state("worker")} == {0}
    cluster.set_flags(TARGET)
    cluster.up(3)
    what = lambda: f"the end of the learner, which says:\n{cluster.said()}\n"  # noqa: E731
    wait_for(lambda: not cluster.containers("learner"), 900, what, LOOK_EVERY_S)
    wait_for(lambda: not cluster.containers("worker"), 60, "the workers' way home", LOOK_EVERY_S)
    assert [state["ExitCode"] for state in cluster.state("learner") + cluster.state("worker")] == [0] * 4
    the_run_is_one_and_its_ledger_balances(cluster)

    cluster.compose(*OBSERVE, "down", "--volumes")
    assert cluster.engine.is_empty()
    not_known = set() if cluster.program is Program.V2 else {"docker compose cp learner:/runs ./runs"}
    assert documented() - cluster.typed == not_known, "what a reader is told to type, and nobody has tried"


def the_images_hold_what_they_need(cluster: Cluster) -> None:
    docker = cluster.engine.docker
    images = {"base": BASE, "worker": f"{cluster.project}-worker", "learner": f"{cluster.project}-learner"}
    megabytes = {name: int(docker("image", "inspect", "--format={{.Size}}", image)) / 1e6 for name, image in images.items()}
    log.info("images: %s", ", ".join(f"{name} {size:.0f} MB" for name, size in megabytes.items()))
    assert megabytes["worker"] <= WORKER_MB
    for name in ("worker", "learner"):
        asks = "id -u; for tool in gcc cc g++ make pip pip3; do command -v $tool && exit 1; done; exit 0"
        assert docker("run", "--rm", "--entrypoint=sh", images[name], "-c", asks) == str(USER)
        asked = ("pip", "torch", "workers", "millrace.workers")
        finds = f"import importlib.util as found; print([bool(found.find_spec(name)) for name in {asked}])"
        held = docker("run", "--rm", "--entrypoint=python", images[name], "-c", finds)
        assert held == str([False, name == "learner", False, True])


def a_worker_that_is_killed_comes_back(cluster: Cluster) -> None:
    killed, *others = cluster.containers("worker")
    cluster.engine.kill(killed)
    look = cluster.engine.look
    wait_for(lambda: look(killed)["RestartCount"] == 1 and look(killed)["State"]["Running"], 30, "the worker's return")
    before = cluster.sees("millrace_received_messages_total", math.isfinite)
    cluster.sees("millrace_received_messages_total", lambda count: count > before)  # a scrape after its death
    cluster.sees(WORKERS, lambda count: count == 3)
    cluster.trains()
    assert {look(other)["RestartCount"] for other in others} == {0}
    log.info("a worker was killed and is back")


def the_learner_that_is_killed_comes_back(cluster: Cluster) -> None:
    (learner,) = cluster.containers("learner")
    began_s = cluster.sees('process_start_time_seconds{job="millrace"}', math.isfinite)
    updates = cluster.sees("millrace_weights_version", lambda version: version > 100)
    cluster.engine.kill(learner)
    wait_for(lambda: cluster.engine.look(learner)["RestartCount"] == 1, 30, "the learner's return")
    cluster.sees('process_start_time_seconds{job="millrace"}', lambda at_s: at_s > began_s)
    cluster.sees(WORKERS, lambda count: count == 3)
    assert cluster.sees("millrace_weights_version", math.isfinite) > updates / 2, "it began anew"
    cluster.trains()
    log.info("the learner was killed and is back, as are its workers")


def the_dashboard_has_data(cluster: Cluster) -> None:
    """Every query, asked as Grafana asks it, has an answer in numbers."""
    queries = [target["expr"] for panel in json.loads(DASHBOARD.read_text())["panels"] for target in panel["targets"]]

    def silent() -> list[str]:
        answers = {query: cluster.ask(query) for query in queries}
        return [query for query, found in answers.items() if not found or not all(map(math.isfinite, found))]

    wait_for(lambda: not silent(), 120, lambda: f"an answer to {silent()}", LOOK_EVERY_S)
    log.info("Prometheus answers all %d queries of the dashboard", len(queries))


def the_metrics_are_well_formed(cluster: Cluster) -> None:
    assert cluster.ask("up") == [1.0]
    reads = "import urllib.request; print(urllib.request.urlopen('http://127.0.0.1:9464/metrics').read().decode(), end='')"
    exposed = cluster.compose("exec", "-T", "learner", "python", "-c", reads)
    checked = subprocess.run(
        ["promtool", "check", "metrics"], input=exposed, capture_output=True, text=True, timeout=60, check=False
    )
    assert (checked.returncode, checked.stdout + checked.stderr) == (0, "")


def every_part_says_that_it_is_well(cluster: Cluster) -> None:
    def health() -> dict[str, str]:
        states = {name: cluster.state(name)[0] for name in ("learner", "prometheus", "tensorboard")}
        return {name: state["Health"]["Status"] for name, state in states.items()}

    wait_for(lambda: set(health().values()) == {"healthy"}, 120, lambda: f"good health of {health()}", LOOK_EVERY_S)
    assert "CartPole-v1-ppo-s1" in cluster.engine.fetch("http://127.0.0.1:6006/data/runs")
    seen = cluster.compose("exec", "-T", "learner", "millrace", "status", "tcp://127.0.0.1:5555", "--json")
    assert len(json.loads(seen)["workers"]) == 3
    assert "env steps" in cluster.said()
    given = "http://127.0.0.1:3000"
    assert cluster.engine.fetch(f"{given}/var/lib/grafana/dashboards/millrace.json").strip() == DASHBOARD.read_text().strip()
    for kind, file in {"dashboards": "millrace", "datasources": "prometheus"}.items():
        assert "apiVersion: 1" in cluster.engine.fetch(f"{given}/etc/grafana/provisioning/{kind}/{file}.yaml")


def the_keys(cluster: Cluster) -> dict[str, str]:
    """Checksum by file: the learner's key and the token, as the learner and a worker read them. Checks owner and mode."""
    (learner,) = cluster.containers("learner")
    worker, *_ = cluster.containers("worker")
    found = {}
    for container, path in (
        (learner, "/keys/own/server.key"),
        (learner, "/keys/own/default.token"),
        (worker, "/token/default.token"),
    ):
        assert cluster.engine.docker("exec", container, "stat", "--format=%u %a", path) == f"{USER} 600"
        found[path] = cluster.engine.docker("exec", container, "sha256sum", path).split()[0]
    assert found["/keys/own/default.token"] == found["/token/default.token"]
    assert cluster.engine.docker("exec", worker, "sh", "-c", "ls -d /keys* || true") == "", "a worker has the learner's key"
    return found


def a_token_that_leaked_lets_nobody_in(cluster: Cluster) -> None:
    keys = the_keys(cluster)
    cluster.compose("run", "--rm", "--entrypoint", "millrace", "keys", "keys", "revoke", "default")
    cluster.sees(WORKERS, lambda count: count == 0)
    cluster.up(3, "--force-recreate")
    cluster.sees(WORKERS, lambda count: count == 3)
    cluster.trains()
    after = the_keys(cluster)
    assert {path for path in keys if keys[path] != after[path]} == {"/keys/own/default.token", "/token/default.token"}
    log.info("a token was revoked and there is a new one")


def the_run_is_one_and_its_ledger_balances(cluster: Cluster) -> None:
    if cluster.program is Program.V2:
        cluster.compose("cp", "learner:/runs", "./runs")
    else:  # it knows no cp
        (learner,) = cluster.containers("learner", running=False)
        cluster.engine.docker("cp", f"{learner}:/runs", cluster.docker_folder / "runs")
    (folder,) = (cluster.docker_folder / "runs").iterdir()
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    log.info("%s after %d env steps", summary["evaluation"], summary["env_steps"])
    assert summary["evaluation"]["return_mean"] >= 475
    config = tomllib.loads((folder / "config.toml").read_text())
    ledgers = [_ledger(row) for row in read_rows(folder / "metrics.jsonl")]
    assert len(ledgers) > 100
    for ledger in [*ledgers, summary["ledger"]]:
        assert 0 <= ledger["outstanding"] <= config["lanes"]
        assert 0 <= ledger["transitions_waiting"] <= config["envs"] * config["ppo"]["rollout_steps"]
    assert summary["ledger"]["transitions_used"] == summary["env_steps"]
    assert summary["ledger"]["lost"] > 0
    assert summary["ledger"]["transitions_invalid"] == summary["ledger"]["messages_bad"] == 0
    log.info("ledger: %s", summary["ledger"])


def _ledger(row: dict[str, Any]) -> dict[str, int]:
    prefix = "ledger/"
    return {name.removeprefix(prefix): count for name, count in row.items() if name.startswith(prefix)}
