"""Actions with a length: their last number says for how many ticks they hold.

The paper's own idea for very frequent actions (after Sharma et al. 2017, FiGAR): the actor decides
seldom and learns how seldom, so that exploration goes somewhere and values are carried over many
ticks at once. An action that holds for n ticks more is as good an experience of the state in its
middle as of the one in which it was chosen: every tick is learnt from, with as many steps.

What is saved is an actor like any other: without the length, it decides anew at every tick.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from msgs_spec.tasks import task_spec
from policy_node.policies.actor import Actor
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.returns import Act
from policy_node.training.experience.transitions import Starts


def ticks_of(length: Array32, most: int) -> NDArray[np.int64]:
    """Ticks, 1 ... `most`, of lengths in [-1, 1], any shape."""
    share = (np.asarray(length, np.float64) + 1.0) / 2.0
    return 1 + np.rint(share * (most - 1)).astype(np.int64)


def length_of(ticks: NDArray[np.int64], most: int) -> Array32:
    """The length in [-1, 1] that means so many ticks, float32."""
    return (2.0 * (ticks - 1) / (most - 1) - 1.0).astype(np.float32)


class Holder:
    """Lets actions hold for their length, in each of several simulations.

    Args:
        most: Ticks of the longest.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._left = np.zeros(0, np.int64)
        self._held: Array32 = np.zeros((0, 0), np.float32)

    def take(self, action: Array32, ticks_left: int) -> Array32:
        """Takes what would be decided now; returns what holds, with the length it has left.

        Args:
            action: (N, action size + 1), taken where nothing holds any more.
            ticks_left: Ticks to the end of the episode, this one included; nothing holds longer.

        Returns:
            (N, action size + 1), float32.
        """
        if len(self._left) != len(action):
            self._left, self._held = np.zeros(len(action), np.int64), action.copy()
        free = self._left == 0
        wanted = np.minimum(ticks_of(action[:, -1], self._most), ticks_left)
        self._left = np.where(free, wanted, self._left)
        held = np.where(free[:, None], action, self._held)
        held[:, -1] = length_of(self._left, self._most)
        self._left, self._held = self._left - 1, held
        return held


@dataclass(frozen=True, slots=True)
class HeldSteps:
    """Returns as long as their action holds.

    Attributes:
        most: Ticks of the longest.
    """

    most: int

    def count(
        self,
        starts: Starts,
        goal: Array32,
        generator: np.random.Generator,
        act: Act | None,
    ) -> NDArray[np.int64]:
        """Returns the number of steps (batch,); arguments as `StepCounter.count` has them."""
        del goal, generator, act
        length = starts.episodes.action[starts.row, starts.tick, -1]
        steps: NDArray[np.int64] = np.minimum(
            ticks_of(length, self.most), starts.last - starts.tick
        )
        return steps


def plain_actor(actor: Actor, config: TrainConfig) -> Actor:
    """An actor as it acts for good: that says nothing of lengths; any other as it is."""
    action_size = task_spec(config.task).robot.action_size
    if actor.shape.action_size == action_size:
        return actor
    plain = Actor(replace(actor.shape, action_size=action_size))
    state = actor.state_dict()
    for name in ('network.output.weight', 'network.output.bias'):
        state[name] = state[name][:action_size].clone()
    plain.load_state_dict(state)
    return plain.eval()
