"""Exit codes, besides 0 and 1, that say why a worker left. Only the worker's supervisor sees the last two; the supervisor
itself exits with 1 or 2 instead.

The supervisor decides after which exit codes a worker is restarted (`supervise/supervisor.py`).
"""

EXIT_REFUSED = 2
"""The learner refused the worker, or the command was wrong."""
EXIT_NO_LEARNER = 69
"""No learner answered. The number is that of EX_UNAVAILABLE in sysexits.h."""
EXIT_UNSUITABLE = 65
"""The worker cannot take part in this run. The number is that of EX_DATAERR in sysexits.h."""
