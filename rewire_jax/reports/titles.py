"""Titles that name what was run, and with what budget."""

from typing import Any

from rewire_jax.envs.scenarios import SCENARIOS


def heading(subject: str, settings: dict[str, Any], tasks: int, members: str) -> str:
    """A title that says what was run, and with what budget.

    Args:
        subject: what the title begins with.
        settings: of the run.
        tasks: of the sequence that it has.
        members: how many seeds or configurations.
    """
    budget, paper = int(settings["interactions"]), settings.get("paper_interactions")
    spec = SCENARIOS.get(settings["scenario"])
    whole = len(spec.changes) * spec.repeats if spec else tasks
    count = "1 task" if tasks == 1 else f"{tasks} tasks"
    rewards = []
    if spec and spec.domain == "metaworld":
        # Its tasks are not those of the version that the paper used.
        subject = f"{subject} on Meta-World v3"
        rewards = [f"reward {settings['reward']}"]
    parts = [
        f"{subject}: {settings['profile']} profile",
        f"{tasks} of {whole} tasks" if tasks < whole else count,
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
