"""Faults, each tried on the real command: the parts of `try_faults.py`."""
