"""Titles that name what was run, and with what budget."""

from typing import Any

from rewire_jax.envs.scenarios import SCENARIOS


def several(count: int, noun: str) -> str:
    """A number of things: 1 seed, 2 seeds."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def heading(
    subject: str,
    settings: dict[str, Any],
    tasks: int,
    seeds: list[int],
    configurations: int = 0,
) -> str:
    """A title that says what was run, and with what budget.

    Args:
        subject: what the title begins with.
        settings: settings of the run.
        tasks: number of trained tasks.
        seeds: how many, of each run.
        configurations: how many, each with all seeds; of a run 0.
    """
    budget, paper = int(settings["interactions"]), settings.get("paper_interactions")
    spec = SCENARIOS.get(settings["scenario"])
    whole = len(spec.changes) * spec.repeats if spec else tasks
    rewards = []
    if spec and spec.domain == "metaworld":
        # Its tasks are not those of the version that the paper used.
        subject = f"{subject} on Meta-World v3"
        rewards = [f"reward {settings['reward']}"]
    least, most = min(seeds), max(seeds)
    members = several(most, "seed") if least == most else f"{least} to {most} seeds"
    if configurations:
        members = f"{several(configurations, 'configuration')} × {members}"
    parts = [
        f"{subject}: {settings['profile']} profile",
        f"{tasks} of {whole} tasks" if tasks < whole else several(tasks, "task"),
        f"{budget:,} interactions a task",
        *rewards,
        f"{settings['backend']} backend",
        members,
    ]
    if paper is not None and budget < int(paper):
        parts.append(f"reduced budget (paper: {int(paper):,})")
    elif paper is None and settings["profile"] != "paper":
        parts.append("reduced budget")
    return ", ".join(parts)
