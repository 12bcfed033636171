"""The supervisor of the workers of one machine: it starts and watches them, and reports to the learner what
they are doing.
"""
