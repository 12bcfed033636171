"""The container files agree with the code: what a worker imports, the flags, the ports, the names of the metrics."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import tomllib
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.samples import Sample

from millrace.cli.main import NOT_IN_WORKERS
from millrace.extras.monitoring.prometheus import MetricsCollector, Observed
from millrace.learner.config.command_line import read_config
from millrace.learner.config.config import Config
from millrace.learner.extras import NEEDED_BY
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.keys.key_folder import KeyFolder
from tests.test_architecture import imported, sources

ROOT = Path(__file__).parents[3]
DOCKER = ROOT / "docker"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Imported where they are used: for policies that process images; for compression; for --vector envpool.
NOT_FOR_WORKERS = {"torch", "zstandard", "envpool"}


def names(file: Path) -> set[str]:
    lines = (line.partition("#")[0].strip() for line in file.read_text().splitlines())
    return {line.partition("==")[0].lower().replace("_", "-") for line in lines if line}


def distributions(requirements: list[str]) -> set[str]:
    """The distributions that these requirements name."""
    return {re.split(r"[\[<>=]", line)[0].lower().replace("_", "-") for line in requirements}


def packages(modules: set[str]) -> set[str]:
    providers = metadata.packages_distributions()
    return {providers[module][0].lower().replace("_", "-") for module in modules}


def test_the_worker_image_holds_what_workers_import_and_nothing_else() -> None:
    folders = ("protocol", "workers", "millrace/flags")
    ours = {"protocol", "workers", "millrace"}
    found = set().union(*(imported(source) for source in sources(*folders) if "/envs/" not in source))
    assert names(DOCKER / "worker.txt") == packages(found - ours - NOT_FOR_WORKERS - sys.stdlib_module_names)
    assert names(DOCKER / "worker.txt") < names(ROOT / "constraints.txt")


IN_A_WORKER_IMAGE = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing!r}:
            raise ModuleNotFoundError(f"{{name}} is not in the worker image", name=name)

sys.meta_path.insert(0, Missing())
import millrace.workers.collect.collector, millrace.workers.worker, millrace.workers.__main__
from millrace.cli.main import main
sys.exit(main(["worker", "tcp://127.0.0.1:1", "--join-timeout-s", "0.01"]))
"""


def test_a_worker_starts_with_the_packages_of_its_image_alone() -> None:
    missing = NOT_IN_WORKERS | {"PIL", "prometheus_client", "resvg_py", "tensorboard", "zstandard"}
    done = subprocess.run(
        [sys.executable, "-c", IN_A_WORKER_IMAGE.format(missing=missing)],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "is the learner running, and is this its address?" in done.stderr


def test_an_installation_holds_what_workers_need_and_the_learner_s_packages() -> None:
    needed = PROJECT["dependencies"]
    assert distributions(needed) == names(DOCKER / "worker.txt") | packages(NOT_IN_WORKERS)


def test_the_build_backend_is_pinned_too() -> None:
    assert "hatchling" in names(ROOT / "constraints.txt")


def test_the_dockerfile_names_no_registry_and_no_stage_runs_as_root() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    assert not re.search(r"https?://|\.(org|io|com)\b", text)
    stages = re.split(r"^FROM ", text, flags=re.MULTILINE)
    shipped = [stage for stage in stages if re.match(r"\S+ AS (worker|learner)\n", stage)]
    assert len(shipped) == 2
    for stage in shipped:
        assert "USER 1000:1000" in stage
        assert "pip" not in re.sub(r"^#.*", "", stage, flags=re.MULTILINE)


# ------------------------------------------------------------------------------------------------------------ compose


@pytest.fixture
def compose() -> dict[str, Any]:
    """compose.yaml with the default of every variable."""
    text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", (DOCKER / "compose.yaml").read_text())
    assert "$" not in re.sub(r"^#.*", "", text, flags=re.MULTILINE)
    found: dict[str, Any] = yaml.safe_load(text)
    return found


def test_the_learner_is_started_with_flags_that_it_knows(compose: dict[str, Any], tmp_path: Path) -> None:
    command, *flags = shlex.split(compose["services"]["learner"]["command"])
    config, resume = read_config(command, [*flags, "--run-dir", str(tmp_path)])
    assert (command, config.env, resume) == ("learner", "CartPole-v1", None)
    assert "--resume auto" in " ".join(flags)


def test_the_learner_image_holds_the_packages_that_its_flags_need(compose: dict[str, Any]) -> None:
    script = re.sub(r"\\\n", "", (DOCKER / "Dockerfile").read_text())
    prints = re.search(r'^RUN (python3 -c "[^"]+")', script, re.MULTILINE)
    assert prints is not None
    command = prints[1].replace("/src/", f"{ROOT}/")
    done = subprocess.run(["sh", "-euc", command], capture_output=True, text=True, timeout=60, check=True)
    _, *flags = shlex.split(compose["services"]["learner"]["command"])
    needed = [needed.install for setting, needed in NEEDED_BY.items() if f"--{setting.replace('_', '-')}" in flags]
    assert sorted(needed) == ["prometheus-client", "tensorboard"]
    assert distributions(done.stdout.split("\n")[:-1]) == distributions([*PROJECT["dependencies"], *needed])


def test_the_ports_of_the_parts_fit_each_other(compose: dict[str, Any]) -> None:
    flags = shlex.split(compose["services"]["learner"]["command"])
    port = flags[flags.index("--bind") + 1].rpartition(":")[2]
    assert shlex.split(compose["services"]["worker"]["command"])[0] == f"tcp://learner:{port}"
    assert f"tcp://127.0.0.1:{port}" in (DOCKER / "Dockerfile").read_text()
    scraped = yaml.safe_load((DOCKER / "prometheus.yml").read_text())["scrape_configs"][0]["static_configs"][0]["targets"]
    assert scraped == [f"learner:{flags[flags.index('--metrics-bind') + 1].rpartition(':')[2]}"]
    for service in compose["services"].values():
        assert all(published.startswith("127.0.0.1:") for published in service.get("ports", []))


def test_a_worker_has_the_token_and_not_the_learners_key(compose: dict[str, Any]) -> None:
    services = compose["services"]
    assert services["worker"]["volumes"] == ["token:/token:ro"]
    assert services["worker"]["environment"]["MILLRACE_TOKEN"] == "/token/default.token"
    assert {name for name, service in services.items() if "keys" in volumes(service)} == {"keys", "learner"}
    assert {name for name, service in services.items() if "token" in volumes(service)} == {"keys", "worker"}
    assert "keys:/keys:ro" in services["learner"]["volumes"]
    assert services["keys"]["environment"]["MILLRACE_KEYS"] == services["learner"]["environment"]["MILLRACE_KEYS"]


def volumes(service: dict[str, Any]) -> set[str]:
    """Names of the volumes, and paths of the files, that a service mounts."""
    return {mount.partition(":")[0] for mount in service.get("volumes", [])}


def test_the_keys_are_made_before_anything_else_starts(compose: dict[str, Any]) -> None:
    completed = {"condition": "service_completed_successfully"}
    for name in ("learner", "worker"):
        assert compose["services"][name]["depends_on"]["keys"] == completed
    assert "build" in compose["services"]["keys"], "docker-compose 1 would look for the image in a registry"
    assert "profiles" not in compose["services"]["keys"]


def test_the_script_that_makes_the_keys_keeps_what_is_there(compose: dict[str, Any], tmp_path: Path) -> None:
    (script,) = compose["services"]["keys"]["command"]
    for folder in ("keys", "token"):
        (tmp_path / folder).mkdir()
        script = script.replace(f"/{folder}/", f"{tmp_path}/{folder}/")
    script = script.replace("millrace keys", f"{sys.executable} -m millrace keys")
    variables = {"PATH": os.defpath, "PYTHONPATH": str(ROOT), "MILLRACE_KEYS": str(tmp_path / "keys" / "own")}
    own, token = tmp_path / "keys" / "own", tmp_path / "token" / "default.token"

    def run() -> tuple[bytes, bytes]:
        subprocess.run(["sh", "-euc", script], cwd=ROOT, env=variables, capture_output=True, timeout=60, check=True)
        assert token.read_bytes() == (own / "default.token").read_bytes()
        assert stat.S_IMODE(token.stat().st_mode) == 0o600
        return (own / "server.key").read_bytes(), token.read_bytes()

    first = run()
    assert run() == first
    KeyFolder(own).revoke("default", datetime.now(UTC).replace(microsecond=0))
    server_key, after = run()
    assert server_key == first[0]
    assert after != first[1], "the token of a key that was revoked was kept"


def test_every_service_comes_back_and_those_of_ours_are_confined(compose: dict[str, Any]) -> None:
    for name, service in compose["services"].items():
        assert name == "keys" or service["restart"] in ("on-failure", "unless-stopped")
        if name in ("learner", "worker", "keys", "tensorboard"):
            assert (service["read_only"], service["cap_drop"], service["init"]) == (True, ["ALL"], True)


# ------------------------------------------------------------------------------------------- Prometheus and Grafana


def exposed_names() -> set[str]:
    observed = Observed(1.0, Progress(return_mean=1.0, length_mean=1.0), Ledger().counts())
    exposition = MetricsCollector(Config(env="CartPole-v1"), observed=observed)
    samples: list[Sample] = [sample for metric in exposition.collect() for sample in metric.samples]
    return {sample.name for sample in samples}


def test_the_dashboard_asks_for_metrics_that_exist() -> None:
    dashboard = json.loads((DOCKER / "grafana/dashboards/millrace.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    used = {name for expr in queries for name in re.findall(r"millrace_\w+", expr)}
    assert used <= exposed_names()
    assert len(used) > 15
    assert {panel["datasource"]["uid"] for panel in dashboard["panels"]} == {"prometheus"}
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])
    (source,) = yaml.safe_load((DOCKER / "grafana/provisioning/datasources/prometheus.yaml").read_text())["datasources"]
    assert (source["uid"], source["url"]) == ("prometheus", "http://prometheus:9090")


def test_panels_do_not_overlap() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in json.loads((DOCKER / "grafana/dashboards/millrace.json").read_text())["panels"]:
        at = panel["gridPos"]
        cells = {(at["x"] + dx, at["y"] + dy) for dx in range(at["w"]) for dy in range(at["h"])}
        assert not cells & taken
        assert at["x"] + at["w"] <= 24
        taken |= cells


def test_prometheus_takes_its_configuration(tmp_path: Path) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed (Debian: apt-get install prometheus)")
    done = subprocess.run(
        [promtool, "check", "config", str(DOCKER / "prometheus.yml")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
