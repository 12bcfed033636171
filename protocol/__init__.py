"""The contract between a worker and the learner. Imports neither of them; README.md in this folder describes the wire."""

if __name__ != "millrace.protocol":  # otherwise each module and class would exist twice
    raise ImportError(f"import millrace.protocol instead of {__name__}", name=__name__)
