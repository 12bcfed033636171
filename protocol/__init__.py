"""The contract: all that a worker and the learner agree on. Imports neither of them; see README.md here for the wire."""

if __name__ != "millrace.protocol":  # else each module would exist twice, and so would each class
    raise ImportError(f"import millrace.protocol instead of {__name__}", name=__name__)
