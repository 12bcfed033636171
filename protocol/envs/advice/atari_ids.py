"""Advice for ALE's ids of Atari games, which lack preprocessing; millrace's environment has the usual wrappers. Pure."""

from __future__ import annotations

import re

_ALE = re.compile(r"ALE/(\w+)-v5|(\w+)NoFrameskip-v[04]")


def preprocessed(env_id: str) -> str:
    """What to write in place of ALE's id of a game to get the usual wrappers (DeepMind's); empty for any other id."""
    match = _ALE.fullmatch(env_id)
    return f"millrace/Atari-v0 --env-kwargs game {match[1] or match[2]}" if match else ""


def instead_of_vector(env_id: str) -> str:
    """What to do if copies of this id can't be stepped in the way that the run asks for."""
    ours = preprocessed(env_id)
    return f"take {ours}, or use --vector loop" if ours else "use --vector loop"
