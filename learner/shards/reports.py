"""What each shard says of its part of a minibatch, in a fixed number of bytes, so that its gather needs no agreement.

Law: numbers of a minibatch are means over its rows, so those of its parts are averaged by their rows. If one process fails,
all learn why, and none takes the step.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import torch
from torch import Tensor

from millrace.protocol.errors import UsageError

MOST_BYTES = 4096
MOST_ERROR = 1000  # characters
NOTHING = b"\xc1"  # a report ends with a text, and UTF-8 has no such byte


class Report(msgspec.Struct, frozen=True, array_like=True):
    """Of one shard's part of a minibatch."""

    rows: int
    numbers: dict[str, float] = {}
    """means over the rows: what the loss logs, and the loss"""
    error: str = ""
    """why this process cannot take the step"""

    def encoded(self) -> Tensor:
        """As a tensor of bytes [MOST_BYTES]. Raises `UsageError` if there are too many numbers."""
        error = self.error[:MOST_ERROR].encode(errors="replace").decode()
        content = msgspec.msgpack.encode(msgspec.structs.replace(self, error=error))
        if len(content) > MOST_BYTES:
            raise UsageError(
                f"shards: a loss logs {len(self.numbers)} numbers, {len(content)} bytes; expected at most {MOST_BYTES} bytes"
            )
        return torch.from_numpy(np.frombuffer(bytearray(content.ljust(MOST_BYTES, NOTHING)), np.uint8))

    @staticmethod
    def of(padded: Tensor) -> Report:
        """The report in a tensor of bytes."""
        return msgspec.msgpack.decode(padded.numpy().tobytes().rstrip(NOTHING), type=Report)


def averaged(reports: Sequence[Report]) -> dict[str, float]:
    """The numbers of a whole minibatch: each is averaged over the parts that have it, by their rows."""
    sums: dict[str, float] = {}
    rows: dict[str, int] = {}
    for report in reports:
        for name, number in report.numbers.items():
            sums[name] = sums.get(name, 0.0) + report.rows * number
            rows[name] = rows.get(name, 0) + report.rows
    return {name: total / rows[name] for name, total in sums.items()}
