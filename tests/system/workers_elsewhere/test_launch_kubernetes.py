"""The commands of the Kubernetes manifest, run unchanged as plain processes: keys, learner, probes, workers."""

from __future__ import annotations

import base64
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from millrace.cli.main import main
from tests.system.stage import preloaded
from tests.system.stage.processes import START_S, Learner, Stage, free_port


def manifest(capsys: pytest.CaptureFixture[str], tmp_path: Path, *argv: str) -> dict[str, Any]:
    """The documents, by kind. Mounted paths are changed to the folder of the test, and the Service to loopback."""
    assert main(["launch", "kubernetes", "CartPole-v1", "--keys", str(tmp_path / "made"), *argv]) == 0
    text = capsys.readouterr().out
    for mounted in ("/secret", "/keys", "/runs"):
        text = text.replace(mounted, f"{tmp_path}{mounted}")
    port, metrics_port = free_port(), free_port()
    for there, here in (
        (f"tcp://millrace:{5555}", f"tcp://127.0.0.1:{port}"),
        (f"tcp://127.0.0.1:{5555}", f"tcp://127.0.0.1:{port}"),
        (f"tcp://0.0.0.0:{5555}", f"tcp://127.0.0.1:{port}"),
        (f"0.0.0.0:{9464}", f"127.0.0.1:{metrics_port}"),
    ):
        assert there in text
        text = text.replace(there, here)
    return {document["kind"]: document for document in yaml.safe_load_all(text)}


def with_variables(container: dict[str, Any], secret: dict[str, bytes]) -> list[str]:
    """The `env` command that gives a process the environment variables of the container."""
    found = {}
    for variable in container["env"]:
        key = variable.get("valueFrom", {}).get("secretKeyRef", {}).get("key")
        found[variable["name"]] = variable["value"] if key is None else secret[key].decode()
    return ["env", *(f"{name}={value}" for name, value in found.items())]


def test_the_commands_of_the_manifest_train(capsys: pytest.CaptureFixture[str], stage: Stage, tmp_path: Path) -> None:
    found = manifest(
        capsys, tmp_path, "--workers", "2", "--", "--steps", "4096", "--eval-episodes", "1", "--min-workers", "2"
    )
    secret = {name: base64.b64decode(content) for name, content in found["Secret"]["data"].items()}
    (tmp_path / "secret").mkdir()
    for name, content in secret.items():
        (tmp_path / "secret" / name).write_bytes(content)
        (tmp_path / "secret" / name).chmod(0o440)  # as Kubernetes mounts a Secret where fsGroup is set
    (tmp_path / "keys").mkdir(mode=0o2777)
    pod = found["Job"]["spec"]["template"]["spec"]
    (keys,), (learner,) = pod["initContainers"], pod["containers"]
    subprocess.run(keys["command"], timeout=10, check=True)

    program = [*with_variables(learner, secret), sys.executable, "-m", "millrace"]
    said = tmp_path / "learner.log"
    stage.runs.mkdir()
    started = Learner([*program, *learner["args"]], said, stage.runs)
    stage.started.append(started)
    started.is_open()
    for probe in ("startupProbe", "livenessProbe"):
        name, *asks = learner[probe]["exec"]["command"]
        assert name == "millrace"
        done = preloaded.run([*program, *asks], timeout=60, env={**os.environ, "PYTHONPATH": "."})
        assert done.returncode == 0, done.stderr
    (worker,) = found["Deployment"]["spec"]["template"]["spec"]["containers"]
    command = [*with_variables(worker, secret), sys.executable, "-m", "millrace.workers", *worker["args"]]
    workers = [stage.start(command, f"w{number}") for number in range(found["Deployment"]["spec"]["replicas"])]
    assert started.ends(START_S) == 0, started.said()
    for each in workers:
        each.hears("waiting for a learner", times=2)
        each.signal(signal.SIGTERM)  # as Kubernetes does when the Deployment is deleted
    assert [each.ends() for each in workers] == [0, 0]
    summary = started.summary()
    assert summary["stop_reason"] == "all steps done", summary
    assert summary["ledger"]["issued"] == summary["ledger"]["used"] + sum(
        summary["ledger"][how] for how in ("outstanding", "lost")
    )
