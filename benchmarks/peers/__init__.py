"""PPO of other systems as separate programs, each in its own environment. They take settings by millrace's names.

Rule: a file here that runs in a peer's environment imports that peer and `benchmarks.peers`, and nothing else of millrace.
"""
