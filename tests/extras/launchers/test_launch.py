"""What the launchers write: the checkers of the engines accept it, and our command line accepts the commands in it."""

from __future__ import annotations

import base64
import os
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import kubernetes_validate
import pytest
import yaml

from millrace.cli.main import main
from millrace.learner.config.command_line import read_config
from millrace.protocol.keys.key_folder import KeyFolder

ROOT = Path(__file__).parents[3]
KUBERNETES = ("1.29", "1.31", "1.34", "1.37")
DEFAULTS = ("kubernetes", "CartPole-v1", "--workers", "3", "--", "--steps", "1000")


def test_what_ray_refuses_is_one_line_that_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As when an actor of this name is there already."""

    def refuse(**options: object) -> None:
        raise ValueError("The name workers-0 is already taken.\nPlease use a different name.")

    node = {"NodeID": 1, "NodeManagerAddress": "127.0.0.1"}
    context = SimpleNamespace(get_node_id=lambda: 1)
    fake = SimpleNamespace(init=lambda **options: None, remote=refuse, nodes=lambda: [node], shutdown=lambda: None)
    fake.get_runtime_context = lambda: context
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setitem(sys.modules, "millrace.extras.launchers.ray", fake)
    del sys.modules["millrace.extras.launchers.ray"]  # imported here with this Ray, and forgotten afterwards
    assert main(["launch", "ray", "CartPole-v1", "--", "--keys", str(tmp_path / "keys"), "--run-dir", str(tmp_path)]) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert line == "millrace: ray: ValueError: The name workers-0 is already taken. Please use a different name."


def launched(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    assert main(["launch", *argv]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        ([""], "launch: which command? expected one of kubernetes, slurm, ray"),
        (["kubernetes"], "missing"),
        (["kubernetes", "CartPole-v1", "--workers", "0"], "workers: expected int >= 1, got 0"),
        (["kubernetes", "CartPole-v1", "--name", "My_Run"], "expected lowercase letters, digits and dashes"),
        (["kubernetes", "CartPole-v1", "--name", "true"], "expected lowercase letters, digits and dashes"),
        (["kubernetes", "CartPole-v1", "--", "--lerning-rate", "1"], "unknown flag --lerning-rate"),
        (["kubernetes", "CartPole-v1", "--", "--bind=tcp://*:1"], "--bind=tcp://*:1 is set by the launcher"),
        (["kubernetes", "CartPole-v1", "--", "--metrics-bind", "*:1"], "--metrics-bind is set by the launcher"),
        (["slurm", "CartPole-v1", "--folder", "/a folder"], "sbatch takes no spaces, quotes or %"),
        (
            ["slurm", "CartPole-v1", "--folder", "~nobody.here/x"],
            "~nobody.here/x: this home folder is not known here",
        ),
        (["slurm", "CartPole-v1", "--cpus", "0"], "cpus: expected int >= 1, got 0"),
    ],
)
def test_what_a_cluster_would_refuse_later_is_refused_at_once(
    capsys: pytest.CaptureFixture[str], argv: list[str], says: str
) -> None:
    assert main(["launch", *argv]) == 2
    out, err = capsys.readouterr()
    assert says in err
    assert (out, err.count("\n")) == ("", 1)


@pytest.mark.parametrize("launcher", ["kubernetes", "slurm"])
def test_what_is_written_is_all_that_a_launcher_says(caplog: pytest.LogCaptureFixture, launcher: str) -> None:
    """Nothing of a run to resume: which that is, the learner finds out on the cluster."""
    assert main(["launch", launcher, "CartPole-v1"]) == 0
    assert not caplog.messages


# --------------------------------------------------------------------------------------------------------- Kubernetes


def documents(text: str) -> dict[str, dict[str, Any]]:
    """By kind: the manifest has one of each."""
    found = list(yaml.safe_load_all(text))
    assert len({document["kind"] for document in found}) == len(found)
    return {document["kind"]: document for document in found}


def container(document: dict[str, Any]) -> dict[str, Any]:
    (found,) = document["spec"]["template"]["spec"]["containers"]
    return dict(found)


@pytest.fixture
def cluster(capsys: pytest.CaptureFixture[str]) -> dict[str, dict[str, Any]]:
    return documents(launched(capsys, *DEFAULTS))


@pytest.mark.parametrize("version", KUBERNETES)
def test_the_manifest_is_what_kubernetes_knows(capsys: pytest.CaptureFixture[str], tmp_path: Path, version: str) -> None:
    found = documents(launched(capsys, *DEFAULTS[:4], "--keys", str(tmp_path / "keys")))
    assert found.keys() == {
        "Secret", "Service", "PersistentVolumeClaim", "Job", "Deployment", "PodDisruptionBudget"
    }  # fmt: skip
    for document in found.values():
        kubernetes_validate.validate(document, version, strict=True)


def test_the_checker_sees_a_wrong_name(cluster: dict[str, dict[str, Any]]) -> None:
    cluster["Job"]["spec"]["template"]["spec"]["initContainer"] = []
    with pytest.raises(kubernetes_validate.ValidationError, match="initContainer"):
        kubernetes_validate.validate(cluster["Job"], KUBERNETES[-1], strict=True)


def test_the_learners_command_is_one_that_it_knows(cluster: dict[str, dict[str, Any]]) -> None:
    command, *flags = container(cluster["Job"])["args"]
    config, resume = read_config(command, flags)
    assert (command, config.env, config.steps, config.run_dir, resume) == ("learner", "CartPole-v1", 1000, "/runs", None)
    assert config.advertise == cluster["Service"]["metadata"]["name"]


def test_ports_names_and_labels_fit_each_other(cluster: dict[str, dict[str, Any]]) -> None:
    learner, workers = cluster["Job"]["spec"]["template"], cluster["Deployment"]["spec"]["template"]
    service = cluster["Service"]
    ports = {port["name"]: port["port"] for port in service["spec"]["ports"]}
    assert ports == {port["name"]: port["containerPort"] for port in container(cluster["Job"])["ports"]}
    flags = container(cluster["Job"])["args"]
    assert flags[flags.index("--bind") + 1].endswith(f":{ports['workers']}")
    assert flags[flags.index("--metrics-bind") + 1].endswith(f":{ports['metrics']}")
    assert container(cluster["Deployment"])["args"][0] == f"tcp://{service['metadata']['name']}:{ports['workers']}"
    assert service["spec"]["selector"].items() <= learner["metadata"]["labels"].items()
    assert not service["spec"]["selector"].items() <= workers["metadata"]["labels"].items()
    for kind in ("Deployment", "PodDisruptionBudget"):
        assert cluster[kind]["spec"]["selector"]["matchLabels"].items() <= workers["metadata"]["labels"].items()
    volumes = {volume["name"]: volume for volume in learner["spec"]["volumes"]}
    claim = volumes["runs"]["persistentVolumeClaim"]["claimName"]
    assert claim == cluster["PersistentVolumeClaim"]["metadata"]["name"]
    for document in (learner, workers):
        known = {volume["name"] for volume in document["spec"]["volumes"]}
        for each in document["spec"].get("initContainers", []) + document["spec"]["containers"]:
            assert {mount["name"] for mount in each["volumeMounts"]} <= known


def test_every_container_has_bounds_and_may_do_nothing_else(cluster: dict[str, dict[str, Any]]) -> None:
    for kind in ("Job", "Deployment"):
        pod = cluster[kind]["spec"]["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"]
        for each in pod.get("initContainers", []) + pod["containers"]:
            assert each["resources"]["requests"].keys() == {"cpu", "memory"}
            assert each["resources"]["limits"]["memory"] == each["resources"]["requests"]["memory"]
            confined = each["securityContext"]
            assert (confined["readOnlyRootFilesystem"], confined["capabilities"]["drop"]) == (True, ["ALL"])
    assert {"startupProbe", "readinessProbe", "livenessProbe"} <= container(cluster["Job"]).keys()


def test_the_secret_is_the_key_folder_and_there_only_when_asked_for(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "keys"
    text = launched(capsys, *DEFAULTS[:4], "--keys", str(folder))
    secret = documents(text)["Secret"]
    data = {name: base64.b64decode(content) for name, content in secret["data"].items()}
    assert data == {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"server.key", "allowed.toml", "default.token"} == data.keys()
    assert "This file holds keys" in text
    without = launched(capsys, *DEFAULTS)
    assert "Secret" not in documents(without)
    assert f"kubectl create secret generic {secret['metadata']['name']} --from-file=" in without


def test_a_key_folder_without_the_workers_token_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    KeyFolder(tmp_path / "keys").new("alice", datetime.now(UTC))
    assert main(["launch", *DEFAULTS[:4], "--keys", str(tmp_path / "keys")]) == 2
    expected = f"keys: expected default.token, the token of the workers; `millrace keys new default --keys {tmp_path}/keys`"
    assert expected in capsys.readouterr().err


def test_a_workers_pod_has_the_token_and_not_the_learners_key(cluster: dict[str, dict[str, Any]]) -> None:
    pod = cluster["Deployment"]["spec"]["template"]["spec"]
    assert not [volume for volume in pod["volumes"] if "secret" in volume]
    (variable,) = container(cluster["Deployment"])["env"]
    assert (variable["name"], variable["valueFrom"]["secretKeyRef"]["key"]) == ("MILLRACE_TOKEN", "default.token")


def test_kubernetes_expands_no_variable_in_our_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    text = launched(capsys, *DEFAULTS, "--env-kwargs", "render_mode", '$(HOME)\u2028é: {"x"} a$$b')
    assert container(documents(text)["Job"])["args"][-5] == '$$(HOME)\u2028é: {"x"} a$$$$b'


def test_a_workers_pod_says_what_it_runs_because_the_image_with_pytorch_is_the_learners(
    cluster: dict[str, dict[str, Any]],
) -> None:
    assert container(cluster["Deployment"])["command"] == ["millrace", "worker"]


def test_a_value_that_reads_like_a_flag_of_the_launcher_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    text = launched(capsys, *DEFAULTS, "--env-kwargs", "keys", "3", "--info-keys", "resume")
    assert {"keys", "resume"} <= {*container(documents(text)["Job"])["args"]}


def of_the_page() -> dict[str, dict[str, Any]]:
    shown = re.findall(r"<<'END'\n(.*?)^END", (ROOT / "docs/how-to/clusters.md").read_text(), re.DOTALL | re.MULTILINE)
    return documents("---\n".join(shown))


def test_the_page_shows_what_kubernetes_knows() -> None:
    kubernetes_validate.validate(of_the_page()["Pod"], KUBERNETES[-1], strict=True)


def test_the_autoscaler_of_the_page_scales_the_workers_to_what_their_learner_wants(
    cluster: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    """Its query, evaluated by Prometheus: 4 while that learner runs, whatever another wants; nothing when it has ended."""
    scaled = of_the_page()["ScaledObject"]["spec"]
    assert scaled["scaleTargetRef"]["name"] == cluster["Deployment"]["metadata"]["name"]
    if (promtool := shutil.which("promtool")) is None:
        pytest.skip("promtool is not installed (Debian: apt-get install prometheus)")
    labels = cluster["Job"]["spec"]["template"]["metadata"]["labels"]
    pods = [("millrace-learner", labels["app.kubernetes.io/name"], "4x4 stale"), ("other-learner", "other", "7x9")]
    series = [
        {"series": f'millrace_workers_wanted{{pod="{pod}", app_kubernetes_io_name="{name}"}}', "values": values}
        for pod, name, values in pods
    ]
    (trigger,) = scaled["triggers"]
    expected = [("1m", [{"labels": "{}", "value": 4}]), ("6m", [])]
    asked = [{"expr": trigger["metadata"]["query"], "eval_time": at, "exp_samples": samples} for at, samples in expected]
    test = {"tests": [{"interval": "1m", "input_series": series, "promql_expr_test": asked}]}
    (tmp_path / "test.yaml").write_text(yaml.safe_dump(test))
    done = subprocess.run(
        [promtool, "test", "rules", tmp_path / "test.yaml"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


# -------------------------------------------------------------------------------------------------------------- Slurm


def test_the_script_is_one_that_a_shell_and_sbatch_know(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    text = launched(capsys, "slurm", "CartPole-v1", "--workers", "3", "--folder", str(tmp_path), "--partition", "short")
    checker = shutil.which("shellcheck", path=f"{Path(sys.executable).parent}:{os.defpath}")
    assert checker is not None
    done = subprocess.run(
        [checker, "--severity=warning", "-"], input=text, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout
    options = dict(re.findall(r"^#SBATCH --([-a-z]+)=(.*)$", text, re.MULTILINE))
    assert (options["ntasks"], options["signal"], options["partition"]) == ("4", "B:USR1@120", "short")
    assert options["output"].startswith(str(tmp_path))
    assert "#SBATCH --requeue\n" in text


def test_special_characters_in_a_flag_reach_the_learner_unchanged(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    odd = "a 'b' $HOME `id` \\"
    flags = ("--env-kwargs", "render_mode", odd)
    text = launched(capsys, "slurm", "CartPole-v1", "--folder", str(tmp_path), "--", *flags, "--seed", "7")
    (line,) = re.findall(r"^.*\[@\]\}\" learner (.* \\\n.*) &$", text, re.MULTILINE)
    said = subprocess.run(
        ["bash", "-c", f"port=5; folder=f; printf '%s\\0' learner {line}"], capture_output=True, timeout=10, check=True
    ).stdout
    command, *argv = said.decode().split("\0")[:-1]
    config, _ = read_config(command, [*argv, "--run-dir", str(tmp_path)])
    assert (config.env, config.seed, config.env_kwargs) == ("CartPole-v1", 7, {"render_mode": odd})
    assert (config.bind, config.keys, config.launched_workers) == ("tcp://0.0.0.0:5", "f/keys", 4)
