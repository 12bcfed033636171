"""Start a learner and workers on a cluster: `millrace launch`."""
