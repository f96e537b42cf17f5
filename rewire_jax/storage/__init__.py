"""Files of a run: checkpoints by Orbax, run folders, tables, and reading them."""
