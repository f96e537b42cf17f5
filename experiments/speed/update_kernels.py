"""Kernels and branches of one update, with a branch in each and in groups."""

import jax

from experiments.speed.kernels import kernels
from experiments.speed.part import Effort, Part
from experiments.speed.updates import METHODS, updates
from experiments.suite import Row, show

_DELAY = 2  # of policy and targets, as published
FORMS = {"a branch in each": 1, "groups": _DELAY}


def measure(effort: Effort) -> list[Row]:
    """A row for each policy and form of the loop."""
    rows = []
    for policy, method in METHODS.items():
        settings = effort.settings(method, policy_delay=_DELAY, target_delay=_DELAY)
        for form, group in FORMS.items():
            state, advance, batches = updates(settings, group)
            compiled = jax.jit(advance).lower(state, batches, 64).compile()
            # Other loops inside that of rounds draw random numbers or sort.
            largest = max(
                (row for row in kernels(compiled) if row["depth"] == 2),
                key=lambda row: row["kernels"],
            )
            rows.append(
                {"policy": policy, "form": form, "updates": group}
                | {"kernels": largest["kernels"] / group}
                | {"conditional": largest["conditional"] / group}
            )
    return rows


PART = Part(
    title="Kernels of one update",
    reading="Kernels that the loop over updates launches, divided by the number of "
    "updates, counted in the compiled program on this device. All kernels of a branch "
    "count, although only every second update runs them. In groups, the compiler "
    "knows which updates train the policy, so only these contain its kernels. On a "
    "GPU, a branch also waits for the host. So a GPU makes updates in groups, and a "
    "CPU with a branch in each update.",
    measure=measure,
    columns={
        "policy": show("policy"),
        "form": show("form"),
        "kernels an update": show("kernels", ".0f"),
        "branches an update": show("conditional", ".0f"),
    },
)
