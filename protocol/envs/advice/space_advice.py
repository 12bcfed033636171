"""Suggests a wrapper that converts an environment's observations to arrays, if no policy supports them. Pure."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium import spaces

from millrace.protocol.envs.space_records import describe_space
from millrace.protocol.errors import words_an_error

IMAGES_ONLY = {"minigrid": "minigrid.wrappers:ImgObsWrapper", "babyai": "minigrid.wrappers:ImgObsWrapper"}
"""For packages whose observations contain an image and text: the wrapper that keeps only the image."""


@words_an_error
def observation_advice(env: gymnasium.Env[Any, Any]) -> str:
    """How to wrap an environment whose observation space is not supported, as the end of a line."""
    space = env.observation_space
    package = str(type(env.unwrapped).__module__).partition(".")[0]
    own = "--wrappers my_module:MyWrapper, your own gymnasium.ObservationWrapper that returns arrays"
    match space:
        case spaces.Dict():
            kept: list[str | int] = [key for key, inner in space.spaces.items() if _is_supported(inner)]
        case spaces.Tuple():
            kept = [index for index, inner in enumerate(space.spaces) if _is_supported(inner)]
        case spaces.Text():
            return "wrap it: --wrappers gymnasium.wrappers:FlattenObservation makes it an array"
        case _:
            return f"wrap it: {own}"
    if package in IMAGES_ONLY and "image" in kept:
        return f"wrap it: --wrappers {IMAGES_ONLY[package]} keeps only the image"
    if not kept:
        return f"wrap it: {own}"
    return f'wrap it: --wrappers "gymnasium.wrappers:FilterObservation(filter_keys={kept!r})" keeps only what is supported'


def _is_supported(space: gymnasium.Space[Any]) -> bool:
    try:
        describe_space(space)
    except Exception:  # not only a `UsageError`: the space may be user-defined
        return False
    return True
