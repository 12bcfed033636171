"""A new run starts from another: what it takes, what starts anew, and what is refused in one line."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithms import Algorithm, algorithm_class
from millrace.learner.algorithms.rainbow import Rainbow
from millrace.learner.algorithms.replay.continuous import Continuous
from millrace.learner.config.config import Config
from millrace.learner.config.layers import resolve
from millrace.learner.resume_checks import unless_finished
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.run_folder import RunFolder, Which
from millrace.learner.run_state import RunState, SavedRun, start_from
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UserFacingError
from millrace.protocol.policy.layout import buffer_layout, named_views
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.support.in_process.saved_policies import policy_run
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, batch, no_pulse
from tests.support.variants import variants

SMALL: dict[str, Any] = {"net": (16,), "normalize_observations": True, "normalize_rewards": True, "rollout_steps": 20}
OFF_POLICY = SMALL | {"batch_size": 16, "replay_size": 1000}
SETTINGS: dict[str, dict[str, Any]] = {
    "ppo": SMALL, "a2c": SMALL, "reinforce": SMALL,
    "dqn": OFF_POLICY | {"learning_starts": 0, "gradient_steps": 4},
    "rainbow": OFF_POLICY | {"learning_starts": 0, "gradient_steps": 4, "quantiles": 8},
    "sac": OFF_POLICY | {"learning_starts": 50}, "td3": OFF_POLICY | {"learning_starts": 50},
    "tqc": OFF_POLICY | {"learning_starts": 50, "updates_per_step": 0.1},
    "crossq": OFF_POLICY | {"learning_starts": 50, "updates_per_step": 0.1, "critic_net": (16,)},
    "xqc": OFF_POLICY | {"learning_starts": 50, "updates_per_step": 0.1, "critic_net": (16,), "atoms": 11},
}  # fmt: skip
SPACES = {name: DISCRETE if name in ("dqn", "rainbow") else GAUSSIAN for name in SETTINGS}
ALL = pytest.mark.parametrize("algo", ["ppo", "dqn", "rainbow", "sac", "td3", "tqc", "xqc"])


def made(algo: str, folder: Path, spaces: PolicySpec | None = None, seed: int = 2, **settings: Any) -> tuple[Config, Any]:
    """A new algorithm, and the settings of its run in this folder."""
    config = resolve("made:Env-v0", algo=algo, run_dir=folder, **SETTINGS[algo] | settings)
    kind: Any = algorithm_class(algo)
    spaces = spaces or SPACES[algo]
    spec = kind.policy_spec(config.algorithm, spaces.observation, spaces.action)
    return config, kind(config.algorithm, spec, total_steps=config.steps, seed=seed)


def rows(algorithm: Any, seed: int) -> Batch:
    """Rows to learn from; actions are in [-1, 1]."""
    acts = made("ppo", Path())[1] if isinstance(algorithm, Continuous) else algorithm
    found = batch(acts, seed)
    return msgspec.structs.replace(found, action=found.action.clip(-1, 1)) if acts is not algorithm else found


def save(run: RunFolder, algorithm: Any, *, best: bool = False) -> None:
    parameters, buffers = algorithm.weights()
    which: Which = "best" if best else "final"
    run.write_policy(policy_run(algorithm.policy, EnvSpec("made:Env-v0")), parameters, buffers, which)


def earlier_run(algo: str, folder: Path, **settings: Any) -> tuple[Path, Any]:
    """The folder of a run that has made two updates, and its algorithm. Its best policy is that of version 0."""
    config, algorithm = made(algo, folder / "earlier", seed=1, **settings)
    run = RunFolder.create(config)
    save(run, algorithm, best=True)
    for seed in (1, 2):
        algorithm.update(rows(algorithm, seed), no_pulse)
    save(run, algorithm)
    content = SavedRun(state=RunState(version=2)).checkpoint_content(algorithm)
    checkpoint.save(run.path, content, env_steps=algorithm.env_steps, keep=3)
    return run.path, algorithm


def started(algo: str, folder: Path, start: Path, **settings: Any) -> tuple[Any, str]:
    config, algorithm = made(algo, folder / "new", start_from=start, **settings)
    return algorithm, start_from(config, algorithm.policy, algorithm)


def refusal(algo: str, folder: Path, start: Path, **settings: Any) -> str:
    with pytest.raises(UserFacingError) as raised:
        started(algo, folder, start, **settings)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def statistics(algorithm: Any) -> dict[str, Any]:
    """Those of the observations, as they are published."""
    return {
        name: found
        for name, found in named_views(algorithm.weights()[1], buffer_layout(algorithm.policy)).items()
        if name.startswith("observation")
    }


def actor_size(algorithm: Any) -> int:
    """The number of parameters of the actor. Workers may act with fewer: layers after normalization, means of quantiles."""
    if isinstance(algorithm, Rainbow):
        return len(algorithm.net.flat)
    return len(algorithm.net.actor) if hasattr(algorithm.net, "actor") else len(algorithm.weights()[0])


def with_those_of_its_actor(algorithm: Any, fresh: torch.Tensor) -> torch.Tensor:
    """Running statistics of batch normalization: the mean and variance of each input of the actor's layers, then others."""
    if isinstance(algorithm, Rainbow):
        assert not torch.equal(algorithm.net.statistics, fresh)
        return algorithm.net.statistics
    actors = sum(2 * size for size in algorithm.net.actor_body.shape.sizes[:-1])
    assert not torch.equal(algorithm.net.statistics[:actors], fresh[:actors])
    return torch.cat([algorithm.net.statistics[:actors], fresh[actors:]])


# ------------------------------------------------------------------------------------------------------ what is taken


@ALL
def test_the_policy_and_the_statistics_are_taken_and_all_else_starts_anew(tmp_path: Path, algo: str) -> None:
    run, before = earlier_run(algo, tmp_path)
    algorithm, said = started(algo, tmp_path, run, from_parts="policy")
    fresh = made(algo, tmp_path / "new")[1].state_dict()
    P = actor_size(before)
    assert said == f"starts from {run} (made:Env-v0): policy, statistics, after {before.env_steps} env steps"
    assert np.array_equal(algorithm.weights()[0], before.weights()[0])
    assert not np.array_equal(algorithm.weights()[0], made(algo, tmp_path)[1].weights()[0])
    state, theirs = algorithm.state_dict(), before.state_dict()
    assert first_difference(state.pop("observations"), theirs["observations"]) is None
    assert first_difference(state.pop("rewards"), theirs["rewards"] | {"returns": {}}) is None
    for name in ("parameters", "target"):
        if name in state:
            assert first_difference(state.pop(name), torch.cat([theirs["parameters"][:P], fresh[name][P:]])) is None
    if "statistics" in state:  # of batch normalization
        assert first_difference(state.pop("statistics"), with_those_of_its_actor(before, fresh["statistics"])) is None
    assert state.pop("acts_at_once", True)
    assert first_difference(state, {name: fresh[name] for name in state}) is None


@ALL
def test_all_weights_are_taken_with_the_critic_and_the_moments_of_optimizers_with_all(tmp_path: Path, algo: str) -> None:
    run, before = earlier_run(algo, tmp_path)
    theirs = before.state_dict()
    fresh = made(algo, tmp_path, learning_rate=0.25)[1].state_dict()
    weights = [name for name in ("parameters", "target", "statistics", "log_temperature") if name in fresh]
    optimizers = [name for name in fresh if name.endswith("optimizer")]
    for parts, kept in (("critic", fresh), ("all", theirs)):
        algorithm, said = started(algo, tmp_path, run, from_parts=parts, learning_rate=0.25)
        assert f" policy, statistics, critic{', optimizers' * (parts == 'all')}, after " in said
        state = algorithm.state_dict()
        assert first_difference({name: state[name] for name in weights}, {name: theirs[name] for name in weights}) is None
        for name in optimizers:
            assert first_difference(state[name]["state"], kept[name]["state"]) is None
        assert (algorithm.env_steps, algorithm.version) == (0, 0)
        algorithm.update(rows(algorithm, 3), no_pulse)
        assert {each.param_groups[0]["lr"] for each in algorithm.optimizers.values()} == {0.25}


@pytest.mark.parametrize(("algo", "critic"), [("ppo", ""), ("dqn", ""), ("sac", ", critic"), ("td3", ", critic")])
def test_the_critic_comes_too_where_the_actor_follows_it_at_once(tmp_path: Path, algo: str, critic: str) -> None:
    run, before = earlier_run(algo, tmp_path)
    assert f"): policy, statistics{critic}, after " in started(algo, tmp_path, run)[1]
    shutil.rmtree(run / "checkpoints")
    algorithm, said = started(algo, tmp_path, run)
    assert said.endswith("): policy")
    assert np.array_equal(algorithm.weights()[0], before.weights()[0])


@pytest.mark.parametrize("algo", variants(["crossq", "xqc"], default=["xqc"]))
def test_a_policy_alone_is_refused_by_an_algorithm_that_needs_the_statistics_of_its_normalization(
    tmp_path: Path, algo: str
) -> None:
    """Workers act with a policy into which they are folded."""
    run, _ = earlier_run(algo, tmp_path)
    shutil.rmtree(run / "checkpoints")
    for parts in ("auto", "policy", "best"):
        line = refusal(algo, tmp_path, run, from_parts=parts)
        assert "expected a run of the same algorithm with a checkpoint, got a policy without the statistics of batch" in line


@pytest.mark.parametrize(
    ("algo", "earlier", "expected"),
    [
        ("sac", "xqc", "expected none as in this run, got before activations"),
        ("tqc", "crossq", "expected none as in this run, got after activations"),
        ("xqc", "crossq", "expected before activations as in this run, got after activations"),
        ("xqc", "sac", "expected a run of the same algorithm with a checkpoint, got a policy without the statistics"),
    ],
)
def test_an_actor_of_another_kind_is_refused(tmp_path: Path, algo: str, earlier: str, expected: str) -> None:
    """Its policy is described alike, and workers act with it alike, but its parameters mean something else."""
    run, _ = earlier_run(earlier, tmp_path)
    assert expected in refusal(algo, tmp_path, run, from_parts="policy")


@pytest.mark.parametrize("earlier", ["tqc", "xqc"])
def test_the_policy_that_workers_act_with_is_one_of_sac(tmp_path: Path, earlier: str) -> None:
    run, before = earlier_run(earlier, tmp_path)
    shutil.rmtree(run / "checkpoints")
    algorithm, _ = started("sac", tmp_path, run)
    assert np.array_equal(algorithm.weights()[0], before.weights()[0])


@pytest.mark.parametrize("earlier", ["dqn", "rainbow"])
def test_action_values_are_not_enough_for_a_network_of_quantiles(tmp_path: Path, earlier: str) -> None:
    run, _ = earlier_run(earlier, tmp_path, dueling=True)
    shutil.rmtree(run / "checkpoints")
    line = refusal("rainbow", tmp_path, run)
    assert "expected a run of rainbow with a checkpoint, got action values without the quantiles" in line


def test_the_policy_that_workers_of_rainbow_act_with_is_one_of_dqn(tmp_path: Path) -> None:
    run, before = earlier_run("rainbow", tmp_path)
    shutil.rmtree(run / "checkpoints")
    algorithm, _ = started("dqn", tmp_path, run, dueling=True)
    assert np.array_equal(algorithm.weights()[0], before.weights()[0])


@pytest.mark.parametrize("algo", ["dqn", "rainbow"])
def test_a_network_of_another_number_of_quantiles_is_refused(tmp_path: Path, algo: str) -> None:
    run, _ = earlier_run("rainbow", tmp_path, quantiles=5)
    line = refusal(algo, tmp_path, run, dueling=True)
    assert f"expected the state of {algo}, got another (" in line
    assert ": expected torch.float32 [" in line


@pytest.mark.parametrize("algo", variants(["crossq", "xqc"], default=["crossq"]))
def test_normalized_networks_start_with_the_critic_and_all_statistics(tmp_path: Path, algo: str) -> None:
    run, before = earlier_run(algo, tmp_path)
    algorithm, _ = started(algo, tmp_path, run, from_parts="critic")
    assert first_difference(algorithm.net.statistics, before.net.statistics) is None
    assert first_difference(algorithm.net.flat, before.net.flat) is None


def test_a_fixed_temperature_is_a_setting_and_is_not_taken(tmp_path: Path) -> None:
    run, _ = earlier_run("sac", tmp_path)
    algorithm, _ = started("sac", tmp_path, run, from_parts="critic", ent_coef=0.125)
    assert algorithm.log_temperature.exp().item() == pytest.approx(0.125, rel=1e-6)


@pytest.mark.parametrize("parts", ["auto", "policy", "critic", "all"])
def test_a_temperature_that_was_fixed_is_learned_from_its_initial_value(tmp_path: Path, parts: str) -> None:
    run, before = earlier_run("sac", tmp_path, ent_coef=0.125)
    algorithm, _ = started("sac", tmp_path, run, from_parts=parts)
    assert algorithm.log_temperature.item() == 0
    assert torch.equal(algorithm.net.actor, before.net.actor)
    assert torch.equal(algorithm.net.critics, before.net.critics) == (parts != "policy")
    algorithm.update(rows(algorithm, 3), no_pulse)
    assert algorithm.log_temperature.item() != 0


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_no_uniform_actions_come_first(tmp_path: Path, algo: str) -> None:
    """Also after a resume before learning_starts."""
    algorithm, _ = started(algo, tmp_path, earlier_run(algo, tmp_path)[0])
    fresh, resumed = made(algo, tmp_path)[1], made(algo, tmp_path)[1]
    assert fresh.weights()[1][-1] == 1
    resumed.load_state_dict(algorithm.state_dict())
    assert algorithm.weights()[1][-1] == resumed.weights()[1][-1] == 0


def test_a_policy_alone_brings_the_statistics_that_it_acts_with(tmp_path: Path) -> None:
    """They count as much as all observations of the new run: a first batch of other observations moves them little."""
    run, before = earlier_run("ppo", tmp_path)
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("policy.json", "policy.safetensors"):
        (alone / name).write_bytes((run / name).read_bytes())
    algorithm, said = started("ppo", tmp_path, alone, steps=1_000_000)
    assert said == f"starts from {alone} (made:Env-v0): policy"
    for got, expected in zip(algorithm.weights(), before.weights(), strict=True):
        np.testing.assert_array_max_ulp(got, expected, 1)  # a variance is the square of a float32
    found = statistics(algorithm)
    algorithm.update(rows(algorithm, 3), no_pulse)
    for name, now in statistics(algorithm).items():
        np.testing.assert_allclose(now, found[name], atol=0.01)
    assert "from_parts critic: expected a run with a checkpoint, got only a policy" in refusal(
        "ppo", tmp_path, alone, from_parts="critic"
    )


def test_the_best_policy_is_that_of_the_best_evaluation(tmp_path: Path) -> None:
    run, _ = earlier_run("ppo", tmp_path)
    algorithm, said = started("ppo", tmp_path, run, from_parts="best")
    assert said.endswith(": best policy")
    assert np.array_equal(algorithm.weights()[0], made("ppo", tmp_path, seed=1)[1].weights()[0])


def test_another_algorithm_with_the_same_layout_takes_policy_and_critic(tmp_path: Path) -> None:
    run, before = earlier_run("ppo", tmp_path)
    algorithm, _ = started("a2c", tmp_path, run, from_parts="critic")
    assert first_difference(algorithm.state_dict()["parameters"], before.state_dict()["parameters"]) is None


# ------------------------------------------------------------------------------------------------------ what is refused


def test_a_policy_of_other_spaces_or_settings_is_refused_in_a_line_that_shows_both(tmp_path: Path) -> None:
    run, _ = earlier_run("ppo", tmp_path)
    wider = msgspec.structs.replace(GAUSSIAN.observation[0], shape=(5,))
    for spaces, expected in (
        (msgspec.structs.replace(GAUSSIAN, observation=(wider,)), r"observation of its policy: expected Leaf"),
        (
            msgspec.structs.replace(GAUSSIAN, observation=(*GAUSSIAN.observation, wider)),
            "expected 2 arrays as in this run, got 1 arrays",
        ),
        (DISCRETE, "action of its policy: expected ActionSpec(kind='discrete'"),
    ):
        with pytest.raises(UserFacingError, match="start_from") as raised:
            config, algorithm = made("ppo", tmp_path, spaces, start_from=run)
            start_from(config, algorithm.policy, algorithm)
        assert expected in str(raised.value)
    assert "net of its policy: expected (8, 8) as in this run, got (16,)" in refusal("ppo", tmp_path, run, net=(8, 8))
    assert "head of its policy: expected squashed as in this run, got actor_critic" in refusal(
        "sac", tmp_path, run, net=(8, 8)
    )
    assert "normalize_observations of its policy" in refusal("ppo", tmp_path, run, normalize_observations=False)


def test_the_moments_of_another_optimizer_are_refused(tmp_path: Path) -> None:
    run, _ = earlier_run("ppo", tmp_path)
    line = refusal("a2c", tmp_path, run, from_parts="all", optimizer="rmsprop")
    assert "optimizer: expected step, square_avg" in line
    assert "got step, exp_avg, exp_avg_sq" in line


def test_a_state_of_another_form_is_refused(tmp_path: Path) -> None:
    """A stranger's checkpoint may hold anything."""
    run, before = earlier_run("ppo", tmp_path)
    state = before.state_dict()
    moments = state["rewards"]["moments"]
    for wrong, expected in (
        ({"parameters": state["parameters"][:-1]}, "parameters: expected torch.float32"),
        ({"parameters": state["parameters"].double()}, "got torch.float64"),
        ({"parameters": "text"}, "'str' object"),
        ({"parameters": torch.full_like(state["parameters"], torch.nan)}, "expected finite weights"),
        ({"observations": moments | {"mean": torch.zeros(3)}}, "shape"),
        ({"rewards": {"moments": moments | {"mean": torch.zeros(3)}}}, "non-scalar"),
        ({"rewards": {}}, "'moments'"),
    ):
        content = {"past": {}, "best_policy": None, "algorithm": state | wrong}
        checkpoint.save(run, content, env_steps=before.env_steps, keep=1)
        line = refusal("ppo", tmp_path, run, from_parts="critic")
        assert line.startswith(f"start_from {run}: ")
        assert expected in line


def test_a_damaged_checkpoint_is_passed_over_and_damage_everywhere_is_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run, before = earlier_run("ppo", tmp_path)
    (run / "checkpoints" / "000000999999.pt").write_bytes(b"cut short")
    algorithm, _ = started("ppo", tmp_path, run)
    assert np.array_equal(algorithm.weights()[0], before.weights()[0])
    assert "000000999999.pt is broken" in caplog.text
    for file in (run / "checkpoints").iterdir():
        file.write_bytes(b"cut short")
    assert "expected a whole checkpoint, got 2 broken" in refusal("ppo", tmp_path, run)
    (run / "policy.safetensors").write_bytes(b"cut short")
    assert f"policy of run {run} cannot be read" in refusal("ppo", tmp_path, run)


def test_a_folder_without_a_policy_is_refused_before_anything_starts(tmp_path: Path) -> None:
    def train(resumption: object) -> Path:
        raise AssertionError("started")

    for parts in ("policy", "best"):
        config, _ = made("ppo", tmp_path, start_from=tmp_path / "nothing", from_parts=parts)
        with pytest.raises(UserFacingError, match=r"nothing: no such folder"):
            unless_finished(config, None, train)
    run, _ = earlier_run("ppo", tmp_path)
    (run / "best.safetensors").unlink()
    config, _ = made("ppo", tmp_path, start_from=run, from_parts="best")
    with pytest.raises(UserFacingError, match=r"expected the best policy, best\.safetensors, got none"):
        unless_finished(config, None, train)


def test_an_algorithm_that_cannot_start_from_another_run_says_so(tmp_path: Path) -> None:
    class Mine(Algorithm):
        __init__ = update = weights = state_dict = load_state_dict = None  # type: ignore[assignment]

    with pytest.raises(UserFacingError, match="Mine does not start from another run"):
        Algorithm.start_from(object.__new__(Mine), None)  # type: ignore[arg-type]


@pytest.mark.parametrize("missing", ["algorithm", "parameters", "optimizer"])
def test_a_checkpoint_that_lacks_a_part_is_one_line(tmp_path: Path, missing: str) -> None:
    run, _ = earlier_run("ppo", tmp_path)
    found = checkpoint.newest(run)[0]
    del (found.state if missing in found.state else found.state["algorithm"])[missing]
    checkpoint.save(run, found.state, found.env_steps, keep=1)
    assert "expected the state of ppo, got another" in refusal("ppo", tmp_path, run, from_parts="all")
