"""Environments behind one interface, `base`."""
