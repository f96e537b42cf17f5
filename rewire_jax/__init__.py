"""Continual reinforcement learning by rewiring neurons, in JAX."""
