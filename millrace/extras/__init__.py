"""The extras, one folder each. They are built on the core. The core imports no extra, and no extra imports another."""
