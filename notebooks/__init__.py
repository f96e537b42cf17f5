"""Notebooks to read, run and start from; `execute.py` runs them all."""
