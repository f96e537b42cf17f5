"""The host's side: train, resume, sweep, evaluate, load policies, log."""
