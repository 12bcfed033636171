"""examples/ppo_jax.py learns, and goes on from what it saved. Needs JAX: `pip install jax`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

pytest.importorskip("jax")

from examples.ppo_jax import Settings, train
from millrace.saved_state import read
from tests.system.stage.network import Network
from tests.system.stage.processes import ROOT, START_S, Stage, wait_for


def test_it_learns_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(tmp_path / "state.npz")
    first = train(Settings(steps=12_000, save=file))
    assert first > 30  # a random policy has about 22
    assert train(Settings(steps=24_000, save=file)) > first
    line = capsys.readouterr().out.splitlines()[-1]
    assert int(line.partition(" env steps")[0].replace(",", "")) < 25_000


@pytest.mark.soak
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_solves_cartpole_with_workers_on_another_host_of_which_one_is_killed(
    stage: Stage, network: Network, tmp_path: Path, seed: int
) -> None:
    here, far = network.host(1), network.host(2)
    address, file = f"tcp://{here.address}:5555", tmp_path / "state.npz"
    keys, token = stage.keys()
    flags = ["--bind", address, "--keys", str(keys), "--save", str(file), "--seed", str(seed)]
    learner = stage.start([*here.before, sys.executable, str(ROOT / "examples" / "ppo_jax.py"), *flags], "learner")
    killed, other = (stage.worker(address, name, "--token", str(token), before=far.before) for name in ("w0", "w1"))
    wait_for(file.exists, START_S, lambda: f"the tenth update; the learner says: {learner.said()}")
    killed.kill()
    assert learner.ends(400) == 0, learner.said()
    assert other.ends() == 0
    found = re.search(r"mean return (\S+);", learner.said())
    assert found, learner.said()
    assert float(found[1]) >= 475
    state, _ = read(file)
    assert max(state.rollouts.incarnations) == 2, state.rollouts  # lanes of the killed worker went to the other one
