"""What starts a learner, with workers on this machine or elsewhere. Learner and workers do not import it."""
