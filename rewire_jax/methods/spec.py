"""Sizes and the network from which methods are made."""

from typing import NamedTuple

from rewire_jax.core.settings import Network


class Spec(NamedTuple):
    """Sizes and the network from which a method builds its policies; all static.

    Attributes:
      observations: length of an observation.
      actions: length of an action.
      hidden: neurons in each hidden layer.
      depth: number of hidden layers.
      tasks: length of the task sequence.
      network: see `SacSettings`. `networks.policy_of` gives the plain policy of a
        network; `networks.ACTIVATIONS` what is between two layers, for
        `networks.between`.
      updates: SAC updates in a task.
      segments: largest number of segments, if the method is not told the tasks, see
        `--boundaries`; else 0. The method itself is then made for this many tasks.
    """

    observations: int
    actions: int
    hidden: int
    depth: int
    tasks: int
    network: Network = "mlp"
    updates: int = 1
    segments: int = 0

    def slots(self, most: int) -> int:
        """Returns the number of slots if tasks recur after `most` places.

        It is unknown which segments are of the same task, so each has a slot.
        """
        return self.tasks if self.segments else min(most, self.tasks)

    def sizes(self, width: int = 0) -> list[int]:
        """Layer sizes of a plain policy, one MLP; `width` 0 means `hidden` neurons."""
        hidden = [width or self.hidden] * self.depth
        return [self.observations, *hidden, 2 * self.actions]
