"""The extras, one folder each, which are built on the core. The core imports no extra, and no extra imports another."""
