"""A real Docker Engine for one test: it runs in namespaces of its own and ends with them.

Rule: its network, mounts and processes are separate, so that nothing of this machine changes (no bridge, no
firewall rule) and nothing outlives it. It cannot reach a registry. It needs root; `why_not` says what is missing.
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

from tests.system.stage.processes import wait_for

log = logging.getLogger("millrace.cluster")

START_S = 60.0
STOP_S = 60.0
CGROUPS = Path("/sys/fs/cgroup")
TOOLS = ("dockerd", "docker", "docker-init", "iptables", "ip", "unshare", "nsenter", "setpriv")
"""the programs that it needs"""

# A separate /run keeps its sockets and pid files apart; the first process reaps orphans of containers.
START = """
umount -l -R /run/netns 2>/dev/null || true
mount -t tmpfs engine /run
ip link set lo up
exec docker-init -s -- dockerd --data-root "$1/data" --exec-root /run/docker --pidfile /run/docker.pid \\
    --host "unix://$1/docker.sock" --group "$(id -g)" --cgroup-parent "$2"
"""


def why_not(tools: Sequence[str] = TOOLS) -> str:
    """The reason why no engine can run here; empty if one can."""
    if os.geteuid() != 0:
        return "a Docker Engine takes root"
    missing = [tool for tool in tools if shutil.which(tool) is None]
    return f"{', '.join(missing)} missing: make packages" if missing else ""


def run(
    command: Sequence[str | Path],
    *,
    within_s: float = 120.0,
    stdin: str | None = None,
    env: Mapping[str, str] | None = None,
    where: Path | None = None,
) -> str:
    """The stdout of a command. If the command fails, the assertion shows its output."""
    done = subprocess.run(
        command, input=stdin, capture_output=True, text=True, timeout=within_s, check=False, cwd=where, env=env
    )
    said = f"{done.stdout[-4_000:]}\n{done.stderr[-4_000:]}"
    assert done.returncode == 0, f"{' '.join(map(str, command))} ended with {done.returncode}:\n{said}"
    return done.stdout


class Engine:
    """A context manager. `environment` holds the environment variables for its Docker clients."""

    def __init__(self, folder: Path) -> None:
        """`folder` holds its log, and its images and volumes, which are deleted when it ends."""
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
        """`docker …`; its stdout."""
        return run(["docker", *arguments], within_s=within_s, env=self.environment).strip()

    def look(self, container: str) -> dict[str, Any]:
        """`docker inspect`."""
        (found,) = json.loads(self.docker("inspect", container))
        assert isinstance(found, dict)
        return found

    def fetch(self, url: str) -> str:
        """Get a URL on the engine's own 127.0.0.1, where it publishes ports, not on this machine's."""
        reads = "import sys, urllib.request; print(urllib.request.urlopen(sys.argv[1], timeout=10).read().decode())"
        return run(["nsenter", f"--target={self._first}", "--net", sys.executable, "-c", reads, url])

    def kill(self, container: str) -> None:
        """Send SIGKILL as the kernel does when memory runs out. `docker kill` would keep Docker from restarting it."""
        process = self.look(container)["State"]["Pid"]
        run(["nsenter", f"--target={self._first}", "--pid", "kill", "-KILL", str(process)])

    def is_empty(self) -> bool:
        """Whether it has no container, no volume, and only the three networks that every engine has."""
        left = [self.docker(*command.split()).split() for command in ("ps -aq", "volume ls -q", "network ls -q")]
        return [len(found) for found in left] == [0, 0, 3]

    def _answers(self) -> bool:
        assert self._process.poll() is None, self.log.read_text()
        asked = subprocess.run(
            ["docker", "version"], env=self.environment, capture_output=True, timeout=START_S, check=False
        )
        return asked.returncode == 0
