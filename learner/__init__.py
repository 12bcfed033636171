"""Learns: the loop, the coordinator of workers, the algorithms. Open train.py first. Never imports millrace.workers."""

if __name__ != "millrace.learner":  # else each module would exist twice, and so would each class
    raise ImportError(f"import millrace.learner instead of {__name__}", name=__name__)
