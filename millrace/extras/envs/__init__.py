"""Environments that come with millrace. Importing this package registers them."""

import gymnasium

gymnasium.register(
    id="millrace/CartDoublePendulum-v0",
    entry_point="millrace.extras.envs.double_pendulum:CartDoublePendulum",
    max_episode_steps=500,
)
gymnasium.register(
    id="millrace/Atari-v0",
    entry_point="millrace.extras.envs.atari:make_game",
    vector_entry_point="millrace.extras.envs.atari:make_games",
)
