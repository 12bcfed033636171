"""Writes a Minari dataset. Minari is an optional dependency and is imported only when it is needed.

Rule: the dataset is complete, or doesn't exist. If writing fails, everything that was made for it is removed. Episodes in
    memory take at most about `CHUNK_BYTES`. Images are stored losslessly, not as JPEG.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

import gymnasium
from gymnasium import spaces

from millrace.extras.datasets.dataset_files import ARRAYS
from millrace.extras.datasets.episode_file import append_episodes
from millrace.extras.datasets.episodes import RecordedEpisode
from millrace.protocol.envs.spaces import make_unflatten
from millrace.protocol.errors import RunError, UsageError, first_line

CHUNK_BYTES = 64 * 2**20
OF_NAMESPACE = "namespace_metadata.json"  # the file that marks a folder as a Minari namespace


class MinariDataset:
    """Writes a Minari dataset into the folder that MINARI_DATASETS_PATH names.

    Use it as a context manager: when the context ends, the dataset is complete. If the body raises, the dataset is removed.
    """

    def __init__(self, dataset_id: str, env: gymnasium.Env[Any, Any], about: str, *, free_version: bool = False) -> None:
        """`env`: the environment that is stored with the dataset. `about`: the dataset's description.

        If a dataset with this id exists, the next free version is used with `free_version`; without it, this is an error.
        Raises `UsageError` if such a dataset can't be made or Minari isn't installed.
        """
        try:
            import h5py  # noqa: F401
            import PIL  # noqa: F401  (Minari needs it, but doesn't require it)
            from minari.dataset.minari_dataset import parse_dataset_id
            from minari.storage import get_dataset_path
        except ImportError as error:
            raise UsageError("recording needs minari; pip install 'minari[hdf5]' pillow") from error
        try:
            _, _, version = parse_dataset_id(dataset_id)
        except (ValueError, TypeError):  # TypeError: a name without a version
            raise UsageError(
                f"dataset {dataset_id}: expected names of two letters or more and a version, as in cartpole/expert-v0"
            ) from None
        for what, space in (("observation", env.observation_space), ("action", env.action_space)):
            if slashed := next((key for key in _keys(space) if "/" in key), None):
                raise UsageError(f"dataset {dataset_id}: Minari cannot keep an {what} whose key has a slash, {slashed}")
        root = get_dataset_path()
        self._folder = get_dataset_path(dataset_id)
        while free_version and self._folder.exists():
            version += 1
            dataset_id = f"{dataset_id.rpartition('-v')[0]}-v{version}"
            self._folder = get_dataset_path(dataset_id)
        if self._folder.exists():
            raise UsageError(f"dataset {dataset_id} is there already, at {self._folder}; choose another name or version")
        self._namespaces = self._folder.parents[: len(self._folder.relative_to(root).parts) - 1]  # innermost first
        self._new_folders = [folder for folder in self._namespaces if not folder.exists()]
        self.id = dataset_id
        self._env = env
        self._about = about
        self._storage: Any = None  # the dataset's files, made when the first episode is written
        self._episodes = self._steps = 0  # numbers of episodes and steps in these files
        self._chunk: list[Any] = []
        self._chunk_bytes = 0

    def add(self, episode: RecordedEpisode) -> None:
        """Add an episode. It may be written later. Raises `RunError` if the dataset cannot be written."""
        from minari.data_collector import EpisodeBuffer

        buffer = EpisodeBuffer(
            seed=episode.seed,
            observations=make_unflatten(self._env.observation_space)(episode.obs),
            actions=make_unflatten(self._env.action_space)(episode.action),
            rewards=episode.reward,
            terminations=episode.terminated,
            truncations=episode.truncated,
            infos={},
        )
        self._chunk.append(buffer)
        self._chunk_bytes += sum(array.nbytes for array in (*episode.action, *episode.obs))
        if self._chunk_bytes > CHUNK_BYTES:
            self._write()

    def close(self) -> None:
        """Write the episodes that are still in memory."""
        if self._chunk:
            self._write()

    def discard(self) -> None:
        """Remove the dataset's folder, and the folders of its namespaces that were made for it."""
        shutil.rmtree(self._folder, ignore_errors=True)
        for folder in self._new_folders:
            with suppress(OSError):
                if {path.name for path in folder.iterdir()} <= {OF_NAMESPACE}:
                    shutil.rmtree(folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if error is None:
                self.close()
        except BaseException as failure:
            error = failure
            raise
        finally:
            if error is not None:
                self.discard()

    def _write(self) -> None:
        try:
            if self._storage is None:
                self._storage = self._new_storage()
            append_episodes(self._storage.data_path / ARRAYS, self._episodes, self._chunk)
            self._episodes += len(self._chunk)
            self._steps += sum(len(episode.rewards) for episode in self._chunk)
            size = self._storage.get_size()
            self._storage.update_metadata(
                {"total_steps": self._steps, "total_episodes": self._episodes, "dataset_size": size}
            )
        except Exception as error:
            says = first_line(error, "")
            raise RunError(f"dataset {self.id} was not written: {type(error).__name__}: {says}") from error
        self._chunk = []
        self._chunk_bytes = 0

    def _new_storage(self) -> Any:
        """Make the dataset's files, without episodes."""
        import minari
        from minari.dataset.minari_storage import MinariStorage

        data = self._folder / "data"
        data.mkdir(parents=True)
        for namespace in self._namespaces:  # Minari's own function isn't used, because it follows links in all datasets
            if not (namespace / OF_NAMESPACE).exists():
                (namespace / OF_NAMESPACE).write_text("{}")
        spec = self._env.spec if _spec_can_be_stored(self._env) else None
        storage = MinariStorage.new(
            data,
            observation_space=self._env.observation_space,
            action_space=self._env.action_space,
            env_spec=spec,
            data_format="hdf5",
            jpeg_encoding=False,  # store images losslessly
        )
        about = {"dataset_id": self.id, "algorithm_name": "millrace", "description": self._about}
        storage.update_metadata(about | {"minari_version": minari.__version__})
        return storage


def _spec_can_be_stored(env: gymnasium.Env[Any, Any]) -> bool:
    """Whether the dataset can store the environment's spec. It can't if the entry point is a class or function."""
    try:
        return env.spec is not None and bool(env.spec.to_json())
    except (TypeError, ValueError):
        return False


def _keys(space: gymnasium.Space[Any]) -> Iterator[str]:
    """The keys of all Dicts in a space."""
    match space:
        case spaces.Dict():
            for key, inner in space.spaces.items():
                yield str(key)
                yield from _keys(inner)
        case spaces.Tuple():
            for inner in space.spaces:
                yield from _keys(inner)
