"""Records episodes of metaworld's scripted experts, to test the compiled tasks.

An episode is recorded until a few steps after its success. Each step has the complete
state of C MuJoCo, so that tests can compare single steps, too. Run it in a virtual
environment with metaworld: `python -m experiments.record_experts`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from metaworld.policies import ENV_POLICY_MAP

from rewire_jax.envs.metaworld import EPISODE_LENGTH
from rewire_jax.envs.metaworld_mujoco import Simulator

STEPS_AFTER = 5
# In window-close the package reads it before the window is moved to its place, so the
# reward's scale follows from an earlier draw.
HANDLE_START = "window_handle_pos_init"


@dataclass(frozen=True, kw_only=True)
class RecordExperts:
    """What to record.

    Attributes:
      tasks: names of the tasks.
      out: folder for the files `<task>.npz`.
    """

    tasks: tuple[str, ...]
    out: Path = Path("tests/data/metaworld")


def record(task: str, seed: int) -> dict[str, np.ndarray]:
    """An expert's episode from a seed.

    Returns:
      `rand_vec`, which the start follows from; `actions [T, 4]`, `rewards [T]`,
      `successes [T]` bool; `observations [T + 1, 39]`, and of MuJoCo's data `qpos`,
      `qvel`, `qacc_warmstart`, `mocap_pos`, `[T + 1, ...]` each; where the task has
      it `window_handle_pos_init`. All float32.
    """
    policy: Any = ENV_POLICY_MAP[f"{task}-v3"]
    expert = policy()
    simulator = Simulator((task,), "v2")
    observation, _ = simulator.reset(seed=seed, options={"task": 0})
    simulation: Any = simulator._current
    fields = ("qpos", "qvel", "qacc_warmstart", "mocap_pos")

    def seen() -> dict[str, Any]:
        data = {field: getattr(simulation.data, field).copy() for field in fields}
        return data | {"observations": observation}

    states = [seen()]
    steps: list[dict[str, Any]] = []
    end = EPISODE_LENGTH
    while len(steps) < end:
        wanted = expert.get_action(observation.astype(np.float64))
        action = np.clip(wanted, -1.0, 1.0).astype(np.float32)
        observation, reward, _, _, info = simulator.step(action)
        success = info["success"]
        if success:
            end = min(end, len(steps) + 1 + STEPS_AFTER)
        states.append(seen())
        steps.append({"actions": action, "rewards": reward, "successes": success})
    record: dict[str, np.ndarray] = {"rand_vec": simulation._last_rand_vec}
    if hasattr(simulation, HANDLE_START):
        record[HANDLE_START] = getattr(simulation, HANDLE_START)
    for rows in states, steps:
        record |= {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return {
        name: value if value.dtype == bool else value.astype(np.float32)
        for name, value in record.items()
    }


def main(job: RecordExperts) -> None:
    """Records each task's first episode that succeeds."""
    job.out.mkdir(parents=True, exist_ok=True)
    for task in job.tasks:
        episodes = (record(task, seed) for seed in range(10))
        solved = next(episode for episode in episodes if episode["successes"].any())
        path = job.out / f"{task}.npz"
        np.savez_compressed(path, allow_pickle=False, **solved)
        print(f"{path}: {len(solved['actions'])} steps, {path.stat().st_size} bytes")


if __name__ == "__main__":
    main(tyro.cli(RecordExperts))
