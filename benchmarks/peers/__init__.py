"""PPO of other systems, as separate programs, each in a virtual environment of its own. Settings have millrace's names.

Rule: a file here that runs in a peer's environment imports that peer and `benchmarks.peers`, but nothing else of millrace.
"""
