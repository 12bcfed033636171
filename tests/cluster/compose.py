"""Runs docker/compose.yaml with a real `docker compose` (the plugin), or with the older program `docker-compose`."""

from __future__ import annotations

import json
import logging
import math
import re
import shutil
import subprocess
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any

from tests.cluster import stock
from tests.cluster.engine import Engine, run
from tests.system.stage.processes import ROOT, wait_for

log = logging.getLogger("millrace.cluster")

BASE, PROMETHEUS, GRAFANA = "millrace-base", "millrace-prometheus", "millrace-grafana"
USER = 1_000
"""the user of the containers, where .env does not name another"""
BUILD_S = 900.0
LOOK_EVERY_S = 1.0  # Prometheus asks the learner every 5 s

IMAGES = {
    # Prometheus from Debian, with the user, paths and wget of the image that compose.yaml names by default.
    PROMETHEUS: f"""
FROM {BASE}
COPY prometheus wget /bin/
RUN install -d -o nobody -g nogroup /prometheus
USER nobody
ENTRYPOINT ["/bin/prometheus"]
CMD ["--config.file=/etc/prometheus/prometheus.yml", "--storage.tsdb.path=/prometheus"]
""",
    # No Debian package has Grafana. A file server replaces it, with the same user and port, serves the files that it reads.
    GRAFANA: f"""
FROM {BASE}
USER 472
ENTRYPOINT ["python3", "-m", "http.server", "3000", "--directory", "/"]
""",
}
WGET = "#!/usr/bin/python3\nimport sys, urllib.request\nurllib.request.urlopen(sys.argv[-1], timeout=5)\n"


class Program(Enum):
    """A program that reads compose.yaml."""

    V2 = ("docker", "compose")
    V1 = ("docker-compose",)


def program() -> Program | None:
    """The newest that is installed; None without one."""
    return next((each for each in Program if shutil.which(each.value[0]) and _is_installed(each)), None)


def _is_installed(what: Program) -> bool:
    done = subprocess.run([*what.value, "version"], capture_output=True, text=True, timeout=60, check=False)
    found = re.search(r"\bv?(\d+)\.\d+\.\d+", done.stdout)
    return done.returncode == 0 and found is not None and (found[1] == "1") is (what is Program.V1)


def prepare(engine: Engine, folder: Path) -> None:
    """Give the engine the images that it cannot get from a registry: the base image, Prometheus and Grafana."""
    engine.docker("import", stock.base(), BASE)
    folder.mkdir()
    prometheus = shutil.which("prometheus")
    assert prometheus is not None
    shutil.copy(prometheus, folder / "prometheus")
    (folder / "wget").write_text(WGET)
    (folder / "wget").chmod(0o755)
    plain = engine.environment | {"DOCKER_BUILDKIT": "0"}
    for image, recipe in IMAGES.items():
        (folder / "Dockerfile").write_text(recipe)
        run(["docker", "build", "--quiet", "--tag", image, folder], env=plain, within_s=BUILD_S)


class Cluster:
    """A clone of the sources, and the compose project in it."""

    def __init__(self, engine: Engine, program: Program, folder: Path) -> None:
        self.engine, self.program, self.folder = engine, program, folder / "clone"
        for source in run(["git", "ls-files", "--cached", "--others", "--exclude-standard"], where=ROOT).splitlines():
            if (ROOT / source).exists():
                (self.folder / source).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / source, self.folder / source, follow_symlinks=False)  # links to folders among them
        for wheel in stock.wheels():
            shutil.copy(wheel, self.folder / "docker" / "wheels")
        self.docker_folder = self.folder / "docker"
        self.typed: set[str] = set()
        """all commands so far, as one would type them for the plugin"""
        self.project = f"millrace-{program.name.lower()}"
        self._environment = engine.environment | {
            "MILLRACE_BASE": BASE,
            "PIP_NO_INDEX": "1",
            "PIP_INDEX_URL": "",
            "PIP_EXTRA_INDEX_URL": "",
            "MILLRACE_LEARNER_IMAGE": f"{self.project}-learner",
            "MILLRACE_WORKER_IMAGE": f"{self.project}-worker",
            "MILLRACE_PROMETHEUS_IMAGE": PROMETHEUS,
            "MILLRACE_GRAFANA_IMAGE": GRAFANA,
            "DOCKER_BUILDKIT": "1" if program is Program.V2 else "0",
        }

    def compose(self, *arguments: str, within_s: float = 180.0) -> str:
        """`docker compose …` in docker/."""
        self.typed.add(" ".join(("docker compose", *arguments)))
        command = [*self.program.value, "--project-name", self.project, *arguments]
        return run(command, within_s=within_s, env=self._environment, where=self.docker_folder)

    def set_flags(self, flags: str) -> None:
        """Set the learner's flags, from the next `up` on."""
        self._environment["MILLRACE_FLAGS"] = flags

    def up(self, workers: int, *arguments: str) -> None:
        """`docker compose up` with so many workers."""
        self.compose("up", "-d", *arguments, "--scale", f"worker={workers}")
        log.info("up: %d workers", workers)

    def containers(self, service: str, *, running: bool = True) -> list[str]:
        """The ids of a service's containers."""
        labels = {"project": self.project, "service": service}
        filters = [f"--filter=label=com.docker.compose.{name}={value}" for name, value in labels.items()]
        return self.engine.docker("ps", "-q", *([] if running else ["-a"]), *filters).split()

    def state(self, service: str) -> list[dict[str, Any]]:
        """`State` of each container of a service, from `docker inspect`."""
        return [self.engine.look(container)["State"] for container in self.containers(service, running=False)]

    def ask(self, query: str) -> list[float]:
        """The answer of Prometheus: one number for each series."""
        quoted = "".join(character if character.isalnum() else f"%{ord(character):02X}" for character in query)
        answer = json.loads(self.engine.fetch(f"http://127.0.0.1:9090/api/v1/query?query={quoted}"))
        return [float(series["value"][1]) for series in answer["data"]["result"]]

    def sees(self, query: str, wanted: Callable[[float], bool], within_s: float = 90.0) -> float:
        """Wait until Prometheus answers with one number that `wanted` accepts; the number."""
        newest: list[float] = []

        def found() -> bool:
            newest[:] = self.ask(query)
            return len(newest) == 1 and wanted(newest[0])

        wait_for(found, within_s, lambda: f"{query}, now {newest}; the learner says:\n{self.said()}\n", LOOK_EVERY_S)
        return newest[0]

    def trains(self) -> None:
        """Wait until the learner has used a thousand more env steps."""
        before = self.sees("millrace_run_env_steps", math.isfinite)
        self.sees("millrace_run_env_steps", lambda steps: steps > before + 1_000)

    def said(self) -> str:
        """The last lines of the learner's log."""
        return self.compose("logs", "--tail=20", "learner")
