"""A task with a gamble: a random landing that looks certain in hindsight.

Plappert et al. 2018, request 2: "Consider an environment with a special action which takes the
agent to a uniformly random state and ends the episode. Such an action would seem to be perfect in
hindsight if we replay with the goal achieved by the agent in the future." FetchReach and FetchPush
ignore their gripper action. Here it is the special action, called a gamble; the random state is
called its landing. Everything else stays as it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Observation, Simulation, StepResult
from fetch_hand_sim.simulation.arguments import Seeds
from msgs_spec.arrays import Array
from msgs_spec.tasks import TaskSpec
from policy_node.training.experience.replay import Episodes

# Index of the unused value of the action, and the value above which it is the gamble.
GRIPPER_ACTION = 3
GAMBLE_ABOVE = 0.9
# Position of the locked fingers after a gamble, otherwise 0 m. Without it the state would not be
# Markov: a landing would look like a state that the robot can leave.
_OVER = 1.0


class GambleSimulation(Simulation):
    """Simulations in which a gamble fixes the observation at a random landing until the next reset.

    The landing is drawn like a goal by the generator of the episode, independent of the desired
    goal. After a gamble, the observation has the achieved goal at the landing, velocities of 0, and
    finger positions of 1 m, which mark a gamble. The physics continue, but are not observed.

    Args:
        task: One of `config.GAMBLE_TASKS`; this class does not check it.
        **options: Options of `Simulation`.
    """

    def __init__(self, task: str, **options: Any) -> None:
        super().__init__(task, **options)
        count = self.num_envs
        self._over = np.zeros(count, np.bool_)
        self._landing = np.zeros((count, self.spec.goal.size))
        self._frozen = np.zeros((count, self.spec.observation_size))
        self._parts = _parts(self.spec)

    def reset(
        self, seed: Seeds = None, ids: ArrayLike | None = None, *given: Any, **options: Any
    ) -> Observation:
        """Start episodes as `Simulation.reset` does; the landing is drawn after the goal."""
        return self._seen(super().reset(seed, ids, *given, **options))

    def _start(self, ids: NDArray[np.intp], *given: Any) -> None:
        super()._start(ids, *given)
        for index in ids.tolist():
            self._over[index] = False
            self._landing[index] = self.task.sample_goal(index, self.generator(index))

    def step(self, actions: ArrayLike) -> StepResult:
        """Step as `Simulation.step` does; the first gripper action above 0.9 is a gamble."""
        result = super().step(actions)
        # If a simulation diverged, the action belonged to the episode before.
        may_gamble = ~(self._over | result.diverged)
        gambles = may_gamble & (np.asarray(actions)[:, GRIPPER_ACTION] > GAMBLE_ABOVE)
        self._freeze(np.flatnonzero(gambles), result.observation['observation'])
        self._over |= gambles
        observation = self._seen(result.observation)
        reward, success = self.metric.evaluate(observation['achieved_goal'], self.goals)
        return StepResult(observation, reward, success, result.diverged)

    def _freeze(self, ids: NDArray[np.intp], observation: Array) -> None:
        """Store the constant observation of simulations `ids`, made from `observation` (N, ...)."""
        frozen, parts = observation[ids], self._parts
        frozen[:, parts[self.spec.achieved_goal]] = self._landing[ids]
        if self.spec.has_object:
            gripper = frozen[:, parts['end_effector_position']]
            frozen[:, parts['object_relative_position']] = self._landing[ids] - gripper
        for name, part in parts.items():
            if name.endswith('velocity'):
                frozen[:, part] = 0.0
        frozen[:, parts['gripper_state']] = _OVER
        self._frozen[ids] = frozen

    def _seen(self, observation: Observation) -> Observation:
        over = self._over[:, None]
        achieved = np.where(over, self._landing, observation['achieved_goal'])
        shown = np.where(over, self._frozen, observation['observation'])
        return {**observation, 'observation': shown, 'achieved_goal': achieved}


def is_over(observation: NDArray[np.floating], spec: TaskSpec) -> NDArray[np.bool_]:
    """Return whether observations (..., observation size) follow a gamble, (...,) booleans."""
    return np.asarray(observation[..., _parts(spec)['gripper_state'].start] == _OVER)


def without_landings(episodes: Episodes, spec: TaskSpec) -> Episodes:
    """Return a copy in which the achieved goal before a gamble replaces all later ones.

    So a landing does not count as a motion of the robot.
    """
    over = is_over(episodes.observation, spec)
    # Once over, an episode stays so; at its start it is not.
    last = np.where(over, 0, np.arange(over.shape[1])).max(axis=1)
    before = episodes.achieved_goal[np.arange(len(last)), last][:, None]
    return replace(
        episodes, achieved_goal=np.where(over[..., None], before, episodes.achieved_goal)
    )


def _parts(spec: TaskSpec) -> dict[str, slice]:
    """Return the slice of each part of an observation vector, by name such as `gripper_state`."""
    starts = np.cumsum([0, *(part.size for part in spec.observation)]).tolist()
    return {
        part.name: slice(start, start + part.size)
        for part, start in zip(spec.observation, starts, strict=False)
    }
