"""Exit codes that say why a worker left, besides 0 and 1. Only its supervisor sees the last two: others get 1 and 2.

The supervisor decides which ends are final, and which workers are restarted (`supervise/supervisor.py`).
"""

EXIT_REFUSED = 2
"""The learner refuses it, or bad usage."""
EXIT_NO_LEARNER = 69
"""No learner answered; as in sysexits."""
EXIT_UNSUITABLE = 65
"""It cannot take part in this run; as in sysexits."""
