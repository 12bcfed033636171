"""A web page that shows run folders and running learners."""

from millrace.extras.monitoring.dashboard.page_beside import Dashboard

__all__ = ["Dashboard"]
