"""Workers step environments and stream rollouts. Never imports learner. Imports torch only for an image policy."""
