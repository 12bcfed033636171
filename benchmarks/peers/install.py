"""Installs the peers: `python -m benchmarks.peers.install [NAME …]`; without a name, all of them.

Each peer has a virtual environment of its own in `benchmarks/peers/envs`, because their pinned versions conflict. They share
one PyTorch in `envs/torch`. A file `shared_torch.pth` in each environment puts that folder behind the environment's own
packages, so torch is found there unless the environment has its own. The installation takes about 1 GB for torch and 2 GB
for the rest.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from typing import NamedTuple

ENVS = Path(__file__).parent / "envs"
TORCH = ENVS / "torch"
DONE = "installed"  # a file of this name marks a complete environment


class Peer(NamedTuple):
    """How to install one peer."""

    steps: tuple[tuple[str, ...], ...]
    """arguments of `pip install`, for one call after another"""
    environ: tuple[tuple[str, str], ...] = ()
    """environment variables during the installation"""
    line: str = ""
    """a line that the environment's Python runs at every start during the installation"""


PEERS = {
    # CleanRL declares Python < 3.11 and pins a torch of 2022. Its PPO is one file, which runs with newer versions.
    "cleanrl": Peer(
        (
            ("gym==0.23.1", "gymnasium==0.29.1", "numpy<2", "pygame-ce", "setuptools<80", "tensorboard"),
            ("--no-deps", "--ignore-requires-python", "cleanrl==1.2.0"),
        )
    ),
    "sample_factory": Peer((("sample-factory==2.1.1", "gymnasium<1.0", "numpy<2"),)),
    # A source package whose build needs a C++ compiler. NO_OCEAN leaves out its own environments, for which it would
    # download files. Its setup.py then lacks a name, which the line of Python defines during the build.
    "pufferlib": Peer(
        (
            ("numpy<2", "Cython", "setuptools<80", "wheel"),
            ("--no-build-isolation", "pufferlib==3.0.0", "gymnasium==0.29.1", "numpy<2"),
        ),
        (("NO_OCEAN", "1"),),
        "import builtins; builtins.c_extension_paths = []",
    ),
    "torchrl": Peer((("torchrl==0.14.1", "gymnasium==1.4.0", "numpy"),)),
    "tianshou": Peer((("tianshou==2.0.1", "gymnasium", "numpy"),)),
    "rllib": Peer((("ray[rllib]==2.60.0",),)),
}


def python(name: str) -> Path:
    """The Python interpreter of this peer's environment."""
    return ENVS / name / "bin" / "python"


def installed() -> list[str]:
    """The peers whose installation is complete."""
    return [name for name in PEERS if (ENVS / name / DONE).exists()]


def install(name: str) -> None:
    """Make the peer's environment from scratch. Raises `CalledProcessError` if an installation step fails."""
    peer = PEERS[name]
    folder = ENVS / name
    share_torch()
    shutil.rmtree(folder, ignore_errors=True)
    venv.create(folder, with_pip=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "shared_torch.pth").write_text(f"{TORCH}\n")
    (packages / "while_installing.pth").write_text(f"{peer.line}\n")
    for step in peer.steps:
        command = [str(python(name)), "-m", "pip", "install", "--quiet", *step]
        subprocess.run(command, env=os.environ | dict(peer.environ) | {"PATH": _path()}, check=True)
    (packages / "while_installing.pth").unlink()
    (folder / DONE).touch()


def _path() -> str:
    """PATH without folders that contain a CUDA compiler, because with one, an extension would be built for a GPU."""
    return os.pathsep.join(folder for folder in os.get_exec_path() if not (Path(folder) / "nvcc").exists())


def share_torch() -> None:
    """Install torch once for all peers, in the version that this Python has."""
    if (TORCH / DONE).exists():
        return
    version = importlib.metadata.version("torch").partition("+")[0]
    shutil.rmtree(TORCH, ignore_errors=True)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(TORCH), f"torch=={version}"]
    subprocess.run(command, check=True)
    (TORCH / DONE).touch()


def main() -> int:
    parser = argparse.ArgumentParser(description="install each peer in its own environment")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(PEERS)}; without a name: all")
    names = parser.parse_args().names or list(PEERS)
    if unknown := [name for name in names if name not in PEERS]:
        parser.error(f"expected names of {', '.join(PEERS)}; got {', '.join(unknown)}")
    failed = []
    for name in names:
        print(f"{name} …", flush=True)
        try:
            install(name)
        except subprocess.CalledProcessError:
            failed.append(name)
    if failed:
        print(f"not installed, and left out of the comparison: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
