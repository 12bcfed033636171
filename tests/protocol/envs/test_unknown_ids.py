"""Ids that gymnasium does not know: plugins of installed packages, and a line that says what to write.

The packages are made here, and nothing is downloaded.
"""

from __future__ import annotations

import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from gymnasium import spaces

from millrace.protocol.env_spec import EnvSpec, remembered_name
from millrace.protocol.envs.description import describe_env
from millrace.protocol.errors import UsageError

GAME = """
import gymnasium
class Game(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None): return 0, {}
    def step(self, action): return 0, 1.0, False, False, {}
"""
REGISTERS_ON_IMPORT = (
    GAME
    + """
gymnasium.register(id="FakeFlappy-v0", entry_point="fake_flappy:Game")
"""
)
REGISTERS_WHEN_CALLED = (
    GAME
    + """
def register_all():
    gymnasium.register("FakeHighway-v0", "fake_highway:Game", max_episode_steps=11)
"""
)


class Site:
    """A folder of installed packages."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def install(self, module: str, source: str, entry_points: str = "") -> None:
        (self.path / module).mkdir()
        (self.path / module / "__init__.py").write_text(source)
        info = self.path / f"{module}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        (info / "RECORD").write_text(f"{module}/__init__.py,,\n{module}-1.0.dist-info/METADATA,,\n")
        if entry_points:
            (info / "entry_points.txt").write_text(entry_points)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """What is imported and registered meanwhile is forgotten."""
    registry, modules = dict(gymnasium.registry), set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)
    yield Site(tmp_path)
    gymnasium.registry.clear()
    gymnasium.registry.update(registry)
    for name in set(sys.modules) - modules:
        if name.startswith("fake_"):
            del sys.modules[name]


def refusal(env_id: str) -> str:
    with pytest.raises(UsageError) as why:
        EnvSpec(env_id).make()
    line = str(why.value)
    assert "\n" not in line
    return line


def test_an_id_that_no_plugin_declares_is_given_with_its_module(site: Site) -> None:
    site.install("fake_flappy", REGISTERS_ON_IMPORT)
    assert "write module:FakeFlappy-v0 with the module that registers it" in refusal("FakeFlappy-v0")
    assert "fake_flappy" not in sys.modules, "a package that declares no plugin is not imported for an id"
    assert type(EnvSpec("fake_flappy:FakeFlappy-v0").make().unwrapped).__name__ == "Game"


def test_a_plugin_that_cannot_be_imported_is_named_with_what_to_install(site: Site) -> None:
    plugin = "[gymnasium.envs]\n__root__ = fake_flappy:register_all\n"
    site.install("fake_flappy", "import pkg_resources_of_old" + REGISTERS_ON_IMPORT, plugin)
    assert refusal("FakeFlappy-v0").endswith(
        "(fake_flappy: ModuleNotFoundError: No module named 'pkg_resources_of_old'; pip install it, then try again)"
    )


def test_a_registered_environment_that_makes_another_one_is_not_blamed(site: Site) -> None:
    gymnasium.register("FakeOuter-v0", entry_point=lambda **_: gymnasium.make("FakeInner-v0"))
    assert refusal("FakeOuter-v0").startswith("environment FakeOuter-v0 cannot be made: ")
    assert "FakeInner" in refusal("FakeOuter-v0")


def test_a_misspelled_id_is_suggested(site: Site) -> None:
    site.install("fake_highway", REGISTERS_WHEN_CALLED, "[gymnasium.envs]\n__root__ = fake_highway:register_all\n")
    assert refusal("FakeHigway-v0").endswith("is not registered: did you mean FakeHighway-v0?")
    assert refusal("CartPol-v1").endswith("did you mean CartPole-v1?")
    site.install("fake_flappy", REGISTERS_ON_IMPORT)
    says = "module fake_flappy neither registers FakeFlapy-v0 nor has such a class or function; did you mean "
    assert refusal("fake_flappy:FakeFlapy-v0").endswith(f"{says}FakeFlappy-v0?")
    assert refusal("fake_flappy:Gamo").endswith("; did you mean fake_flappy:Game?")


def test_what_cannot_be_made_is_not_suggested(site: Site) -> None:
    gymnasium.register("FakeSimulator-v0", "fake_flappy:missing")
    gymnasium.register("FakeSimulators-v0", "fake_flappy:Game")
    site.install("fake_flappy", REGISTERS_ON_IMPORT)
    assert refusal("FakeSimulato-v0").endswith("did you mean FakeSimulators-v0?")


def test_what_can_be_made_after_an_installation_is_suggested_with_it(site: Site) -> None:
    gymnasium.register("FakeSimulator-v0", "fake_absent:Game")
    assert refusal("FakeSimulato-v0").endswith(
        "did you mean FakeSimulator-v0? It cannot be made yet: environment FakeSimulator-v0: a package it needs is missing "
        "(No module named 'fake_absent'); pip install it, then try again"
    )


def test_an_id_that_nothing_resembles_says_how_to_name_its_module(site: Site) -> None:
    assert refusal("Qqqqqqqqqqq-v7") == (
        "environment Qqqqqqqqqqq-v7 is not registered: write module:Qqqqqqqqqqq-v7 with the module that registers it, as in "
        "minigrid:MiniGrid-Empty-5x5-v0; one of a client in another language needs the client (--bind)"
    )


def test_an_id_of_old_atari_wrappers_is_answered_with_ours() -> None:
    assert refusal("FakePongNoFrameskip-v4").endswith("write millrace/Atari-v0 --env-kwargs game FakePong")


@pytest.mark.parametrize(
    "entry_points",
    [
        "[gymnasium.envs]\n__root__ = fake_highway:register_all\n",
        "[gymnasium.envs.__root__]\nfake = fake_highway:register_all\n",  # as highway-env has it
    ],
)
def test_the_plugin_of_an_installed_package_registers_its_ids(site: Site, entry_points: str) -> None:
    site.install("fake_highway", REGISTERS_WHEN_CALLED, entry_points)
    assert "FakeHighway-v0" not in gymnasium.registry
    made = EnvSpec.of("FakeHighway-v0").make()
    assert made.spec is not None
    assert made.spec.max_episode_steps == 11
    assert remembered_name("FakeHighway-v0") == "FakeHighway-v0", "a worker finds it too"
    assert EnvSpec.of("FakeHighway-v0").factory is None


def test_an_id_of_one_s_own_for_a_class_of_a_plugin_is_not_that_of_the_plugin(site: Site) -> None:
    site.install("fake_highway", REGISTERS_WHEN_CALLED, "[gymnasium.envs]\n__root__ = fake_highway:register_all\n")
    EnvSpec("FakeHighway-v0").make()
    gymnasium.register("MyHighway-v0", "fake_highway:Game", max_episode_steps=12)
    assert remembered_name("FakeHighway-v0") == "FakeHighway-v0"
    assert remembered_name("MyHighway-v0") == "__main__:MyHighway-v0"
    assert gymnasium.spec("MyHighway-v0").max_episode_steps == 12, "it is still registered"


def test_a_plugin_may_have_a_namespace(site: Site) -> None:
    site.install("fake_highway", REGISTERS_WHEN_CALLED, "[gymnasium.envs]\nFakeSpace = fake_highway:register_all\n")
    assert type(EnvSpec("FakeSpace/FakeHighway-v0").make().unwrapped).__name__ == "Game"


def test_a_plugin_that_fails_costs_no_more_than_its_ids(site: Site) -> None:
    site.install("fake_broken", "raise OSError('no display')", "[gymnasium.envs]\n__root__ = fake_broken:register_all\n")
    site.install("fake_highway", REGISTERS_WHEN_CALLED, "[gymnasium.envs]\n__root__ = fake_highway:register_all\n")
    assert EnvSpec("FakeHighway-v0").make().spec is not None
    assert refusal("FakeOther-v0").endswith("(fake_broken: OSError: no display)")


def test_no_plugin_is_imported_for_an_id_that_is_known(site: Site) -> None:
    site.install("fake_broken", "raise OSError('no display')", "[gymnasium.envs]\n__root__ = fake_broken:register_all\n")
    for env in ("CartPole-v1", "tests.support.envs.toy:Countdown-v0", "millrace/CartDoublePendulum-v0"):
        EnvSpec.of(env).make().close()
    assert "fake_broken" not in sys.modules


# ------------------------------------------------------------------------------------------- the old package gym


def old_env(monkeypatch: pytest.MonkeyPatch, *, seeded: bool) -> Any:
    """A class as one of gym's, which is registered there as Old-v0. gym itself is not installed."""

    class OldEnv:
        __module__ = "gym.core"

        def seed(self, seed: int) -> None: ...

    OldEnv.reset = (lambda self, *, seed=None: 0) if seeded else (lambda self: 0)  # type: ignore[attr-defined]
    gym = types.SimpleNamespace(envs=types.SimpleNamespace(registration=types.SimpleNamespace(registry={})))
    gym.envs.registration.registry["Old-v0"] = types.SimpleNamespace(entry_point=OldEnv)
    monkeypatch.setitem(sys.modules, "gym", gym)
    return OldEnv


@pytest.mark.parametrize(("seeded", "version"), [(True, "V26"), (False, "V21")])
def test_an_environment_of_the_old_gym_is_answered_with_what_wraps_it(
    site: Site, monkeypatch: pytest.MonkeyPatch, seeded: bool, version: str
) -> None:
    made = old_env(monkeypatch, seeded=seeded)
    site.install("fake_old", "")
    install = "`pip install gym==0.26.2 shimmy`"
    write = f"{install}, then write shimmy:Gym{version}Environment-v0 --env-kwargs env_id fake_old:Old-v0"
    assert refusal("fake_old:Old-v0").endswith(f"is of the old package gym; {write}")
    with pytest.raises(UsageError, match=f"{install}, and return shimmy.Gym{version}CompatibilityV0\\(env=it\\)"):
        EnvSpec.of(made).make()


def test_an_environment_of_the_old_gym_without_seed_is_told_that_shimmy_calls_it(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = old_env(monkeypatch, seeded=False)
    del made.seed
    site.install("fake_old", "")
    advice = (
        "; it also needs a method seed(seed), as under 'Old gym environments' in docs/how-to/third_party_environments.md"
    )
    assert refusal("fake_old:Old-v0").endswith(f"--env-kwargs env_id fake_old:Old-v0{advice}")
    with pytest.raises(UsageError, match=f"CompatibilityV0\\(env=it\\){re.escape(advice)}$"):
        EnvSpec.of(made).make()
    page = Path(__file__).parents[3] / "docs" / "how-to" / "third_party_environments.md"
    assert "\n## Old gym environments\n" in page.read_text()


class WithoutGym:
    """As crafter's environment where gym is not installed: its spaces are tuples with names."""

    action_space = types.SimpleNamespace(n=17)

    def seed(self, seed: int) -> None: ...

    def reset(self) -> int:
        return 0

    def step(self, action: int) -> tuple[int, float, bool, dict[str, Any]]:
        return 0, 0.0, False, {}


def test_what_does_without_gym_but_has_its_interface_is_answered_as_one_of_gym() -> None:
    with pytest.raises(UsageError, match=r"got WithoutGym; it has the interface of the old package gym: .*GymV21Compat"):
        EnvSpec.of(WithoutGym).make()


# ------------------------------------------------------------------------------- observations that no policy takes


class Observes(gymnasium.Env[Any, Any]):
    action_space = spaces.Discrete(2)

    def __init__(self, space: gymnasium.Space[Any], module: str = "mine") -> None:
        self.observation_space = space
        self.__class__ = type("Observes", (Observes,), {"__module__": module})


GRID = {"image": spaces.Box(0, 9, (7, 7, 3)), "direction": spaces.Discrete(4), "mission": spaces.Text(9)}


@pytest.mark.parametrize(
    ("env", "advice"),
    [
        (
            Observes(spaces.Dict(GRID)),
            """ "gymnasium.wrappers:FilterObservation(filter_keys=['direction', 'image'])" keeps only what is supported""",
        ),
        (Observes(spaces.Dict(GRID), "minigrid.envs.empty"), "minigrid.wrappers:ImgObsWrapper keeps only the image"),
        (
            Observes(spaces.Tuple([spaces.Text(3), spaces.Discrete(2)])),
            '--wrappers "gymnasium.wrappers:FilterObservation(filter_keys=[1])" keeps only what is supported',
        ),
        (Observes(spaces.Text(3)), "--wrappers gymnasium.wrappers:FlattenObservation makes it an array"),
        (Observes(spaces.Graph(spaces.Discrete(2), None)), "your own gymnasium.ObservationWrapper that returns arrays"),
        (Observes(spaces.Dict({"said": spaces.Text(3)})), "your own gymnasium.ObservationWrapper that returns arrays"),
    ],
    ids=["dict", "minigrid", "tuple", "text", "graph", "only text"],
)
def test_the_line_about_observations_names_a_wrapper_that_helps(env: gymnasium.Env[Any, Any], advice: str) -> None:
    with pytest.raises(UsageError) as why:
        describe_env(env)
    line = str(why.value)
    assert line.endswith(advice)
    assert "\n" not in line
    wrapper = line.partition("--wrappers ")[2].partition(" keeps")[0].partition(" makes")[0].strip('"')
    if wrapper.startswith("gymnasium."):
        from millrace.protocol.envs.wrappers import wrap

        describe_env(wrap(env, wrapper))
