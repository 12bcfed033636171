"""The vector environment's lanes: env copies stepped with the learner's actions."""
