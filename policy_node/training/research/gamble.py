"""A task with a gamble: a random landing that only hindsight takes for a sure thing.

Plappert et al. 2018, request 2: "Consider an environment with a special action which takes the
agent to a uniformly random state and ends the episode. Such an action would seem to be perfect in
hindsight if we replay with the goal achieved by the agent in the future." Two Fetch tasks ignore
their gripper action, so it can be that special one and everything else stays as it is.
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

# The idle part of the action, and the value above which it is the gamble.
GRIPPER_ACTION = 3
GAMBLE_ABOVE = 0.9
# The locked fingers, at 0 m otherwise, tell that an episode is over: without it the state of a
# landing would look like one that the robot may still leave, and would be no Markov state.
_OVER = 1.0
_OWN_STATE = ('_over', '_landing', '_frozen')


class GambleSimulation(Simulation):
    """Copies of a task in which gambling moves the achieved goal at random and ends the motion.

    The landing is drawn as goals are, by the generator of the episode, whatever the goal of the
    episode is. From the gamble to the end of the episode the observation stays as it is then: the
    achieved goal at the landing, no velocities, fingers at 1 m. Physics go on beneath, unseen.

    Args:
        task: One of `config.GAMBLE_TASKS`.
        **options: Those of `Simulation`.

    Raises:
        ValueError: If the task uses its gripper, or an option is not allowed.
    """

    def __init__(self, task: str, **options: Any) -> None:
        super().__init__(task, **options)
        self._prepare()

    def _prepare(self) -> None:
        count = self.num_envs
        self._over = np.zeros(count, np.bool_)
        self._landing = np.zeros((count, self.spec.goal.size))
        self._frozen = np.zeros((count, self.spec.observation_size))
        self._parts = _parts(self.spec)

    def __getstate__(self) -> dict[str, Any]:
        """The state of `Simulation`, and which episodes are over and how they look."""
        own = {name: getattr(self, name).copy() for name in _OWN_STATE}
        return {**super().__getstate__(), 'gamble': own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Goes on from the state, to the same bits."""
        super().__setstate__(state)
        self._prepare()
        for name, values in state['gamble'].items():
            setattr(self, name, values.copy())

    def reset(
        self, seed: Seeds = None, ids: ArrayLike | None = None, *given: Any, **options: Any
    ) -> Observation:
        """Start episodes as `Simulation.reset` does; the landing is drawn after the goal."""
        return self._seen(super().reset(seed, ids, *given, **options))

    def _start(self, ids: NDArray[np.intp]) -> None:
        super()._start(ids)
        for index in ids.tolist():
            self._over[index] = False
            self._landing[index] = self._task.sample_goal(index, self.generator(index))

    def step(self, actions: ArrayLike) -> StepResult:
        """Advances every simulation by one tick, as `Simulation.step`; gambles end the motion."""
        result = super().step(actions)
        # Where MuJoCo gave up, the action was for an episode that is no more.
        may_gamble = ~(self._over | result.diverged)
        gambles = may_gamble & (np.asarray(actions)[:, GRIPPER_ACTION] > GAMBLE_ABOVE)
        self._freeze(np.flatnonzero(gambles), result.observation['observation'])
        self._over |= gambles
        observation = self._seen(result.observation)
        reward, success = self.metric.evaluate(observation['achieved_goal'], self.goals)
        return StepResult(observation, reward, success, result.diverged)

    def _freeze(self, ids: NDArray[np.intp], observation: Array) -> None:
        """Remembers what is seen of simulations that have just gambled."""
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
    """Whether a gamble has ended the episode, (...,), from observations (..., size)."""
    return np.asarray(observation[..., _parts(spec)['gripper_state'].start] == _OVER)


def without_landings(episodes: Episodes, spec: TaskSpec) -> Episodes:
    """The episodes with what was achieved by a gamble taken back to what was before it.

    A landing is no motion of the robot's: which episodes have moved something, and how much, is
    decided by what comes before it.
    """
    over = is_over(episodes.observation, spec)
    # Once over, an episode stays so; at its start it is not.
    last = np.where(over, 0, np.arange(over.shape[1])).max(axis=1)
    before = episodes.achieved_goal[np.arange(len(last)), last][:, None]
    return replace(
        episodes, achieved_goal=np.where(over[..., None], before, episodes.achieved_goal)
    )


def _parts(spec: TaskSpec) -> dict[str, slice]:
    """Where the parts of an observation lie, by name."""
    starts = np.cumsum([0, *(part.size for part in spec.observation)]).tolist()
    return {
        part.name: slice(start, start + part.size)
        for part, start in zip(spec.observation, starts, strict=False)
    }
