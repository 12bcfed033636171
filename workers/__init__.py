"""Workers step environments and stream rollouts. Never imports millrace.learner. Imports torch only for an image policy."""

if __name__ != "millrace.workers":  # else each module would exist twice, and so would each class
    raise ImportError(f"import millrace.workers instead of {__name__}", name=__name__)
