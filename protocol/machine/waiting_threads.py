"""Imported before PyTorch, it lets PyTorch's threads sleep while they wait for one another.

By default they spin, and hold the core that the slowest of them needs: beside other busy processes, a pass takes up to sixty
times as long. The library reads the variable only when it is loaded.
"""

from __future__ import annotations

import os
import sys

VARIABLE = "OMP_WAIT_POLICY"
SPIN = "torch" in sys.modules and VARIABLE not in os.environ
"""Whether the threads spin: PyTorch was imported before, and nobody has set the variable."""

os.environ.setdefault(VARIABLE, "PASSIVE")
