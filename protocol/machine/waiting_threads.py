"""Makes PyTorch's threads sleep while they wait for one another. Import this module before PyTorch.

By default, they spin, and thus occupy the core that the slowest thread needs. If other processes are busy, a pass then takes
up to sixty times as long. OpenMP reads the environment variable only when it is loaded, together with PyTorch.
"""

from __future__ import annotations

import os
import sys

VARIABLE = "OMP_WAIT_POLICY"
SPIN = "torch" in sys.modules and VARIABLE not in os.environ
"""Whether the threads spin because PyTorch was imported before the variable was set."""

os.environ.setdefault(VARIABLE, "PASSIVE")
