"""Digests of short runs: what a change of the code's shape must leave as it is.

Trains every method on the probe for two tasks, and rewire and FT-1 briefly on
HalfCheetah and on window-close, by the public interface alone. Prints a digest of the
result rows and one of the policies for each run. Two versions of the code agree if
their outputs do, on the same machine. Kept only while the code is being moved.
"""

import hashlib
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rewire_jax

METHODS = ["ft1", "ft_l2", "packnet", "ewc", "pnn", "sac_n", "ft_n", "csp", "rewire"]
SHORT: dict[str, Any] = {
    "tasks": 2,
    "interactions": 2_560,
    "warmup": 640,
    "eval_episodes": 2,
    "selection_episodes": 1,
    "report_every": 1_280,
    "checkpoint_every": 0,
}


def digest(scenario: str, method: str, folder: Path, **changes: Any) -> str:
    """Trains a run and digests what it wrote and learned."""
    made = rewire_jax.make_scenario(scenario)
    settings = rewire_jax.preset(made, method, "quick")
    settings = replace(settings, **SHORT | changes)
    settings = replace(settings, sac=replace(settings.sac, hidden=16, batch_size=32))
    if method == "csp":
        # Its choice between policies is paid for by the task's own interactions.
        length = made.environment.episode_length
        settings = replace(
            settings,
            interactions=settings.interactions + 8 * length,
            options=replace(settings.options, samples=16, estimations=4),
        )
    rewire_jax.train(settings, folder)
    rows = (folder / "results.jsonl").read_bytes()
    policies = hashlib.sha256()
    loaded = rewire_jax.load_policies(folder)
    for leaf in jax.tree.leaves(loaded.members):
        policies.update(np.ascontiguousarray(leaf).tobytes())
    return f"{hashlib.sha256(rows).hexdigest()[:16]} {policies.hexdigest()[:16]}"


def main() -> None:
    """Prints a line for each run."""
    rewire_jax.keep_compiled()
    runs: list[tuple[str, str, dict[str, Any]]] = [
        ("probe/reach", method, {}) for method in METHODS
    ]
    runs += [("halfcheetah/forgetting", method, {}) for method in ("rewire", "ft1")]
    short = {"tasks": 1, "interactions": 600, "warmup": 200, "random_interactions": 100}
    runs += [
        ("continual_world/window-close", method, short) for method in ("rewire", "ft1")
    ]
    with tempfile.TemporaryDirectory() as folder:
        for number, (scenario, method, changes) in enumerate(runs):
            made = digest(scenario, method, Path(folder) / str(number), **changes)
            print(scenario, method, made)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
