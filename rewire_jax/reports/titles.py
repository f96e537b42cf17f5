"""Titles that name what was run, and with what budget."""

from collections.abc import Mapping
from typing import Any

from rewire_jax.envs.scenarios import SCENARIOS


def several(count: int, noun: str) -> str:
    """A number of things: 1 seed, 2 seeds."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def budget(settings: Mapping[str, Any]) -> str:
    """The interactions of a run, named as reduced where the paper has more.

    Where the paper has none, those of profiles other than `paper` count as reduced.
    """
    given, paper = int(settings["interactions"]), settings.get("paper_interactions")
    text = f"{given:,} interactions a task"
    if paper is None:
        return text if settings["profile"] == "paper" else f"reduced budget of {text}"
    if given < int(paper):
        return f"reduced budget of {text} (paper: {int(paper):,})"
    return text


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
        budget(settings),
        *rewards,
        f"{settings['backend']} backend",
        members,
    ]
    return ", ".join(parts)
