"""The supervisor of one machine's workers: it starts and watches them, and reports to the learner what they are doing."""
