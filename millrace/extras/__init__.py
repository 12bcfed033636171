"""What is built on the core, a folder each. The core imports no extra, and no extra imports another."""
