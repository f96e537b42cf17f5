"""The parts of `experiments.bench_speed`, one a file."""
