"""The supervisor of the workers of one machine: it starts them, watches them, and tells the learner what they are doing."""
