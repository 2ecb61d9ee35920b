"""Readers of files, one module for each family of formats; `read.py` chooses one by the suffix."""
