"""Data sets on disk: one layout a file."""
