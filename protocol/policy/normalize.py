"""How a policy normalizes its observations, in workers and in the learner. Pure. The learner keeps the statistics."""

from __future__ import annotations

import numpy as np

from millrace.protocol.arrays import Doubles, Floats

CLIP = np.float32(10.0)  # normalized observations are clipped to ±10


def normalize(x: Floats | Doubles, mean: Floats, std: Floats) -> Floats:  # rule NORMALIZED
    """(x − mean) / std, clipped to ±10, as float32.

    It is computed in the dtype of x, so that even a large float64 observation keeps the digits in which it differs from the
    mean.
    """
    return np.asarray(np.clip((x - mean) / std, -CLIP, CLIP)).astype(np.float32, copy=False)
