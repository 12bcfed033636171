"""Workers step environments and stream rollouts. Never imports millrace.learner. Imports torch only for an image policy."""

if __name__ != "millrace.workers":  # otherwise each module and class would exist twice
    raise ImportError(f"import millrace.workers instead of {__name__}", name=__name__)
