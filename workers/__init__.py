"""Workers step environments and send rollouts. They never import millrace.learner, and torch only if the policy needs it."""

if __name__ != "millrace.workers":  # otherwise each module and class would exist twice
    raise ImportError(f"import millrace.workers instead of {__name__}", name=__name__)
