"""A round of updates, as methods are told of it."""

from typing import NamedTuple

import jax


class Round(NamedTuple):
    """A round of updates that was made.

    Attributes:
      before: `[]` int, the task's updates before it; shared by all members.
      after: `[]` int, the same with it.
      metrics: `[]` each, metrics of its last update, "temperature" among them.
    """

    before: jax.Array
    after: jax.Array
    metrics: dict[str, jax.Array]

    def completes(self, every: int) -> jax.Array:
        """`[]` bool, whether it made another `every` updates complete.

        All members share it, so under vmap a `cond` on it stays a branch.
        """
        return self.before // every < self.after // every
