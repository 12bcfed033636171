"""A gymnasium vector environment whose copies live in workers."""
