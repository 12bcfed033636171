"""PPO of other systems as programs of their own, each in an environment of its own, with our names for its settings.

Rule: a file here that runs in a peer's environment imports that peer, and of this repository `benchmarks.peers` alone.
"""
