"""Steps environments and streams rollouts. Never imports learner; for an MLP policy, never imports torch."""
