"""Python imports this when it starts, if its folder is on PYTHONPATH: a process whose trace is wanted records it."""

import os

if "MILLRACE_TRACE" in os.environ:
    from tests.model.traces.recorder import install

    install()
