"""The documentation, and what makes its drawings and tables."""
