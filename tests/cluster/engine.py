"""A real Docker Engine of a test's own: it runs in namespaces that nobody else sees, and is gone with them.

The law: its network, mounts and processes are its own, so that nothing of this machine changes (no bridge, no firewall rule)
and nothing can outlive it. Therefore it reaches no registry. Needs root; `why_not` says what is missing.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from tests.system.processes import wait_for

log = logging.getLogger("millrace.cluster")

START_S = 60.0
STOP_S = 60.0
CGROUPS = Path("/sys/fs/cgroup")
TOOLS = {
    "dockerd": "docker.io", "docker": "docker.io", "docker-init": "docker.io",
    "iptables": "iptables", "ip": "iproute2",
    "unshare": "util-linux", "nsenter": "util-linux", "setpriv": "util-linux",
}  # fmt: skip
"""what it takes, and the Debian package that has it"""

# /run is its own, so that its sockets and process ids meet nobody's; the first process reaps what containers leave.
START = """
umount -l -R /run/netns 2>/dev/null || true
mount -t tmpfs engine /run
ip link set lo up
exec docker-init -s -- dockerd --data-root "$1/data" --exec-root /run/docker --pidfile /run/docker.pid \\
    --host "unix://$1/docker.sock" --group "$(id -g)" --cgroup-parent "$2"
"""


def why_not(tools: Mapping[str, str] = TOOLS) -> str:
    """Why there can be no engine here; empty if there can."""
    if os.geteuid() != 0:
        return "a Docker Engine takes root"
    missing = sorted({package for tool, package in tools.items() if shutil.which(tool) is None})
    return f"not installed: apt-get install {' '.join(missing)}" if missing else ""


def run(
    command: Sequence[str | Path],
    *,
    within_s: float = 120.0,
    stdin: str | None = None,
    env: Mapping[str, str] | None = None,
    where: Path | None = None,
) -> str:
    """What the command says on stdout; fails with all that it said if it fails."""
    done = subprocess.run(
        command, input=stdin, capture_output=True, text=True, timeout=within_s, check=False, cwd=where, env=env
    )
    said = f"{done.stdout[-4_000:]}\n{done.stderr[-4_000:]}"
    assert done.returncode == 0, f"{' '.join(map(str, command))} ended with {done.returncode}:\n{said}"
    return done.stdout


class Engine:
    """A context. `environment` is that of a Docker client that shall speak with it."""

    def __init__(self, folder: Path) -> None:
        """`folder` holds its images and volumes, which are deleted when it ends, and its log."""
        self.folder = folder
        self.log = folder / "dockerd.log"
        self.environment = {**os.environ, "DOCKER_HOST": f"unix://{folder / 'docker.sock'}"}
        self._cgroup = f"millrace-{os.getpid()}"

    def __enter__(self) -> Engine:
        ends_with_us = ["setpriv", "--pdeathsig=KILL"]
        namespaces = ["unshare", "--mount", "--net", "--pid", "--fork", "--kill-child", "--mount-proc"]
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                [*ends_with_us, *namespaces, "sh", "-euc", START, "sh", self.folder, self._cgroup], stdout=log, stderr=log
            )
        try:
            wait_for(self._answers, START_S, lambda: f"a Docker Engine, which says:\n{self.log.read_text()}\n")
            (child,) = psutil.Process(self._process.pid).children()
            self._first = child.pid
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._process.poll() is None:
            for child in psutil.Process(self._process.pid).children():
                child.terminate()
        else:
            log.error("the engine ended by itself; its last words:\n%s", self.log.read_text()[-4_000:])
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()  # and all that is in its namespaces
            self._process.wait(STOP_S)
        shutil.rmtree(self.folder / "data", ignore_errors=True)
        (self.folder / "docker.sock").unlink(missing_ok=True)
        for group in sorted(CGROUPS.glob(f"**/{self._cgroup}"), reverse=True):
            for inner in sorted(group.glob("**/"), reverse=True):
                with suppress(OSError):
                    inner.rmdir()

    def docker(self, *arguments: str | Path, within_s: float = 120.0) -> str:
        """`docker …`; what it says on stdout."""
        return run(["docker", *arguments], within_s=within_s, env=self.environment).strip()

    def look(self, container: str) -> dict[str, Any]:
        """`docker inspect`."""
        (found,) = json.loads(self.docker("inspect", container))
        assert isinstance(found, dict)
        return found

    def fetch(self, url: str) -> str:
        """What is at a port that the engine publishes: on its own 127.0.0.1, not on this machine's."""
        reads = "import sys, urllib.request; print(urllib.request.urlopen(sys.argv[1], timeout=10).read().decode())"
        return run(["nsenter", f"--target={self._first}", "--net", sys.executable, "-c", reads, url])

    def kill(self, container: str) -> None:
        """SIGKILL as the kernel sends it when memory runs out: after `docker kill` Docker would not start it again."""
        process = self.look(container)["State"]["Pid"]
        run(["nsenter", f"--target={self._first}", "--pid", "kill", "-KILL", str(process)])

    def is_empty(self) -> bool:
        """No container, volume, or network but the three that it always has."""
        left = [self.docker(*command.split()).split() for command in ("ps -aq", "volume ls -q", "network ls -q")]
        return [len(found) for found in left] == [0, 0, 3]

    def _answers(self) -> bool:
        assert self._process.poll() is None, self.log.read_text()
        asked = subprocess.run(
            ["docker", "version"], env=self.environment, capture_output=True, timeout=START_S, check=False
        )
        return asked.returncode == 0
