"""The HTML report and learning curves of run folders."""
