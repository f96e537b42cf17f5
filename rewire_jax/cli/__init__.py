"""The `rewire-jax` command."""
