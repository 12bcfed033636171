"""Workers that the learner did not start: how they join, what they need, and when they leave."""
