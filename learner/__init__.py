"""Learns: the loop, the coordinator of workers, the algorithms. Open train.py first. Never imports millrace.workers."""

if __name__ != "millrace.learner":  # otherwise each module and class would exist twice
    raise ImportError(f"import millrace.learner instead of {__name__}", name=__name__)
