"""The learner: the training loop, the workers' coordinator and the algorithms. Read train.py first.

This package never imports millrace.workers.
"""

if __name__ != "millrace.learner":  # imported under another name, each module and class would exist twice
    raise ImportError(f"import millrace.learner instead of {__name__}", name=__name__)
