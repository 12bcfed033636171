"""The extras, a folder each: what is built on the core. The core imports no extra, and no extra imports another."""
