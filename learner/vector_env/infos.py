"""The infos of a step: unpacks each lane's bytes into one dict for each row, and merges these dicts as gymnasium does."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gymnasium.vector import VectorEnv

from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.sent_lanes import Infos, Ready
from millrace.protocol.arrays import Array
from millrace.protocol.errors import BadMessage
from millrace.protocol.wire.plain_values import repr_paths, unpack

log = logging.getLogger("millrace.learner")


MOST_WARNED = 32  # paths that the log names, because workers choose the keys, which may contain a step number


class OfSomeRows(VectorEnv[Any, Any, Array]):
    """Merges the infos of some rows, as gymnasium's vector environments merge those of all rows."""

    closed = True  # so that no code tries to close it

    def __init__(self, count: int) -> None:
        self.num_envs = count


class InfoReader:
    """Reads the infos of lanes that have come back."""

    def __init__(self, layout: BatchLayout, refuse: Callable[[int, str], None]) -> None:
        """`refuse` is called with a lane whose infos cannot be read, and the reason."""
        self._layout = layout
        self._refuse = refuse
        self._warned: set[str] = set()  # paths about which the log has warned, because their values arrived as text
        self._warned_of_more = False

    def by_row(self, ready: Ready) -> dict[int, Infos]:
        """The infos that are not empty, by row, in the order of the rows."""
        infos = dict(ready.losses)
        for lane, packed in ready.results.items():
            if not isinstance(packed, bytes) or not packed:
                continue
            try:
                for n, info in unpack_infos(packed, self._layout.rows_of(self._layout.copies(lane))).items():
                    infos[n] = infos.get(n, {}) | info
            except BadMessage as error:
                self._refuse(lane, f"lane {lane}: infos cannot be read: {error}")
        if not infos:
            return infos
        for n in sorted(infos):
            self._warn(n, infos[n])
        return dict(sorted(infos.items()))

    def _warn(self, n: int, info: Infos) -> None:
        """Log each path in the info of row n whose value arrived as its repr, unless it was logged before."""
        if self._warned_of_more:
            return
        for path in repr_paths(info, MOST_WARNED + 1):
            if path in self._warned:
                continue
            if len(self._warned) == MOST_WARNED:
                self._warned_of_more = True
                log.warning("more infos are not plain data; the log doesn't name them")
                return
            self._warned.add(path)
            log.warning("info %s of row %d is not plain data: it arrives as its repr, a string", path, n)


def merged(by_row: Mapping[int, Infos], env: VectorEnv[Any, Any, Array], rows: Sequence[int] | None = None) -> Infos:
    """The infos of these rows, or of all rows if `rows` is None, merged as gymnasium does."""
    infos: Infos = {}
    merges = OfSomeRows(len(rows)) if rows is not None else env
    number_of = range(env.num_envs) if rows is None else {n: number for number, n in enumerate(rows)}
    for n, info in by_row.items():
        infos = merges._add_info(infos, info, number_of[n])
    return infos


def unpack_infos(packed: bytes, rows: Sequence[int]) -> dict[int, Infos]:
    """Unpack the infos of a lane that has these rows. Returns them by row. Raises `BadMessage` if that is impossible."""
    try:
        pairs = [(n, info) for n, info in unpack(packed, len(rows))]
    except (TypeError, ValueError) as error:
        raise BadMessage(str(error)) from error
    for n, info in pairs:
        if type(n) is not int or not isinstance(info, dict):
            raise BadMessage(f"expected pairs of a number and a dict, got {type(n).__name__} and {type(info).__name__}")
    return {rows[n]: info for n, info in pairs if n in range(len(rows))}
