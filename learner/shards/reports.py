"""The shards' reports on their parts of a minibatch. They have a fixed size, so gathering them needs no negotiation.

Law: a minibatch's numbers are means over its rows. They are therefore averages of its parts' numbers, each weighted by the
part's number of rows. If one process fails, all processes learn why, and none takes the step.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import torch
from torch import Tensor

from millrace.protocol.errors import UsageError

MOST_BYTES = 4096
MOST_ERROR = 1000  # the largest number of characters in an error
NOTHING = b"\xc1"  # the padding after a report: a report ends with text, and this byte never occurs in UTF-8


class Report(msgspec.Struct, frozen=True, array_like=True):
    """The report on one shard's part of a minibatch."""

    rows: int
    numbers: dict[str, float] = {}
    """the loss, and the numbers that it logs, as means over the rows"""
    error: str = ""
    """why this process cannot take the step; empty if it can"""

    def encoded(self) -> Tensor:
        """The report as a tensor of bytes [MOST_BYTES]. Raises `UsageError` if it has too many numbers."""
        error = self.error[:MOST_ERROR].encode(errors="replace").decode()
        content = msgspec.msgpack.encode(msgspec.structs.replace(self, error=error))
        if len(content) > MOST_BYTES:
            raise UsageError(
                f"shards: a loss logs {len(self.numbers)} numbers, {len(content)} bytes; expected at most {MOST_BYTES} bytes"
            )
        return torch.from_numpy(np.frombuffer(bytearray(content.ljust(MOST_BYTES, NOTHING)), np.uint8))

    @staticmethod
    def of(padded: Tensor) -> Report:
        """Decode a report from a tensor of bytes."""
        return msgspec.msgpack.decode(padded.numpy().tobytes().rstrip(NOTHING), type=Report)


def averaged(reports: Sequence[Report]) -> dict[str, float]:
    """The numbers of a whole minibatch. Each is averaged over the parts that have it, weighted by their numbers of rows."""
    sums: dict[str, float] = {}
    rows: dict[str, int] = {}
    for report in reports:
        for name, number in report.numbers.items():
            sums[name] = sums.get(name, 0.0) + report.rows * number
            rows[name] = rows.get(name, 0) + report.rows
    return {name: total / rows[name] for name, total in sums.items()}
