"""Every environment that millrace registers passes gymnasium's checker, but for the toys that fail on purpose."""

from __future__ import annotations

from importlib.util import find_spec

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

from tests.support.envs import toy

FAIL_ON_PURPOSE = {f"{kind.__name__}-v0" for kind in (*toy.Faulty.__subclasses__(), toy.OneStep)}  # "truncates after 1 step"
OURS = ("millrace.extras.envs.", "tests.support.envs.")
REGISTERED = [name for name, spec in gymnasium.registry.items() if str(spec.entry_point).startswith(OURS)]


@pytest.mark.filterwarnings("ignore:.*maximum value is infinity")  # Scripted counts without end
@pytest.mark.parametrize("name", sorted({*REGISTERED} - FAIL_ON_PURPOSE))
def test_gymnasiums_checker_finds_no_mistake(name: str) -> None:
    if "Atari" in name and (find_spec("ale_py") is None or find_spec("cv2") is None):
        pytest.skip("no emulator: pip install ale-py opencv-python-headless")
    env = gymnasium.make(name, disable_env_checker=True)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
