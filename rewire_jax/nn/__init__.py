"""The permutation operator with its backward pass, and the networks."""
