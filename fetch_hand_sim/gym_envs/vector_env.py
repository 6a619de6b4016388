"""The vector environment: a `gymnasium.vector.VectorEnv` that steps N copies of a task."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from fetch_hand_sim.episodes.runner import has_ended
from fetch_hand_sim.gym_envs.pictures import RENDER_MODES
from fetch_hand_sim.gym_envs.task_attributes import TaskAttributes, clip_actions
from fetch_hand_sim.simulation import Observation, StepResult
from fetch_hand_sim.simulation.arguments import finite_numbers, require_whole
from msgs_spec.arrays import Array, Flags
from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from msgs_spec.text import one_line, one_of

# Gymnasium's value for episodes without a limit of steps.
_NO_LIMIT = -1
# A window shows one environment.
_RENDER_MODES = [mode for mode in RENDER_MODES if mode != 'human']


class FetchHandVectorEnv(TaskAttributes, VectorEnv[Observation, NDArray[np.float32], Any]):
    """N copies of one task, stepped together on all processors.

    Results equal those of a `SyncVectorEnv` of N single environments bit for bit, in each autoreset
    mode of Gymnasium. `NEXT_STEP`: the step after an episode ends starts the next one, ignores the
    action and has reward 0. `SAME_STEP`: the step that ends an episode starts the next one, and
    `info['final_obs']` is the last observation of the ended episode. `DISABLED`: only `reset` with
    `reset_mask` starts episodes. `pickle` and `copy.deepcopy` keep the state.

    Subclasses may override `compute_reward`, `compute_terminated` and `compute_truncated`. These
    methods take (achieved_goal, desired_goal, info) of all N environments, goals (N, goal size),
    and return (N,). Further arguments are those of `TaskAttributes`; for rates other than 25 Hz
    use `fetch_hand_sim.make_vec`.

    Args:
        num_envs: Number of copies N.
        max_episode_steps: Steps per episode; None for the task's own number, -1 for no limit.
        num_threads: Threads that step the copies; 0 for all processors that the process may use.
        autoreset_mode: When the next episode starts; see above.
        disable_env_checker: Ignored; `gymnasium.make_vec` passes it to batches too.

    Raises:
        ValueError: If an argument is not allowed.
        TypeError: If a subclass overrides `_get_obs`, `_is_success` or `_sample_goal`.
    """

    metadata = {  # noqa: RUF012 - as in gymnasium.vector.VectorEnv
        'autoreset_mode': AutoresetMode.NEXT_STEP,
        'render_modes': _RENDER_MODES,
        'render_fps': int(DEFAULT_CONTROL_HZ),
    }

    _uncalled = ('_get_obs', '_is_success', '_sample_goal')
    _hint = (
        'a batch calls compute_reward, compute_terminated and compute_truncated; single '
        "environments (vectorization_mode='sync') call the others too"
    )

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        num_threads: int = 0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        disable_env_checker: bool | None = None,
        **arguments: Any,
    ) -> None:
        if max_episode_steps not in (None, _NO_LIMIT):
            require_whole('max_episode_steps (-1 for no limit)', max_episode_steps, lowest=1)
        modes = [mode.value for mode in AutoresetMode]
        asked = getattr(autoreset_mode, 'value', autoreset_mode)
        self.autoreset_mode = AutoresetMode(one_of(asked, modes, 'autoreset_mode'))
        super().__init__(task, num_envs=num_envs, num_threads=num_threads, **arguments)
        self.metadata['autoreset_mode'] = self.autoreset_mode
        self.num_envs = num_envs
        self.single_observation_space = self.observation_space
        self.single_action_space = self.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episode_steps = max_episode_steps or self.spec_of_task.episode_ticks
        if max_episode_steps == _NO_LIMIT:
            self._episode_steps = np.iinfo(np.int64).max
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._seeds: list[int | None] = [None] * num_envs

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: One seed (environment i takes seed + i), one per environment, or None to continue
                the random generators.
            options: `reset_mask`, booleans (N,): the environments to start; all by default.
                `goal`, `variation` and `start` as in `FetchHandEnv.reset`: one for all, or one for
                each of N, where None means a random value.

        Returns:
            The observations of all N environments, and an empty dictionary.

        Raises:
            ValueError: If an option is unknown, a mask, goal or seed is invalid, or the number of
                seeds is wrong.
            gymnasium.error.ResetNeeded: If the mask leaves out an environment that was never reset.
        """
        mask = self._reset_mask(options)
        waiting = np.flatnonzero(~(mask | self.simulation.is_started))
        if waiting.size:
            raise gymnasium.error.ResetNeeded(
                f'the first reset is one of all; reset_mask leaves out {waiting.tolist()!s:.60}'
            )
        given = self._read_options(options, mask, 'reset_mask')
        ids = np.flatnonzero(mask)
        seeds = self._each_seed(seed)
        observation = self.simulation.reset(seed=[seeds[i] for i in ids.tolist()], ids=ids, **given)
        for index in ids.tolist():
            if seeds[index] is not None:
                self._seeds[index] = seeds[index]
        self._elapsed[mask] = 0
        self._ended[mask] = False
        return self._ordered(observation), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, Array, Flags, Flags, dict[str, Any]]:
        """Advance all environments by one step.

        In mode `NEXT_STEP`, environments whose episode has ended start the next one instead.

        Args:
            actions: (N, action size), clipped to [-1, 1]; infinite values, too.

        Returns:
            Observations (N, ...), rewards (N,), terminated (N,), truncated (N,) and a dictionary.
            Terminated is False unless a subclass overrides `compute_terminated`. Truncated is True
            at the last step, if MuJoCo diverged, and where `compute_truncated` returns True. The
            dictionary has `is_success` and `diverged` (N,). Their masks `_is_success` and
            `_diverged` are False where this step started an episode. In mode `SAME_STEP` it also
            has `final_obs` (N,), a dictionary for each ended episode, and `final_info`, the
            `is_success` and `diverged` of ended episodes.

        Raises:
            ValueError: If the actions have a wrong shape, a value is NaN, or an overridden method
                returns neither a boolean nor (N,) booleans for the end of episodes.
            gymnasium.error.ResetNeeded: If an environment was never reset or, in mode `DISABLED`,
                its episode has ended.
        """
        started = self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and started.any():
            raise gymnasium.error.ResetNeeded(
                f'episodes {np.flatnonzero(started).tolist()} have ended; reset them first'
            )
        wanted = clip_actions(np.asarray(actions))
        if started.any() and wanted.shape == self.action_space.shape:
            # These only begin an episode; their action is ignored.
            wanted = np.where(started[:, None], wanted.dtype.type(0), wanted)
        before = {i: self._random(i).state for i in np.flatnonzero(started).tolist()}
        result = self.simulation.step(wanted)
        for index in np.flatnonzero(started & result.diverged).tolist():
            # The episode that replaced the diverged one is not played.
            self._random(index).state = before[index]
        observation, reward = result.observation, self._rewards(result)
        success, diverged = result.success, result.diverged & ~started
        if started.any():
            observation = self.simulation.reset(ids=started)
            reward = np.where(started, 0.0, reward)
            success = success & ~started
        self._elapsed = np.where(started, 0, self._elapsed + 1)
        # Not a `RobotEpisode` each: 64 of them cost half a millisecond.
        truncated = has_ended(self._elapsed, self._episode_steps, diverged)
        terminated = self._endings('compute_terminated', result) & ~started
        truncated |= self._endings('compute_truncated', result) & ~started
        self._ended = ended = terminated | truncated
        info = _masked({'is_success': success.astype(np.float64), 'diverged': diverged}, ~started)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            observation, info = self._start_next(observation, info, ended)
        return self._ordered(observation), reward, terminated, truncated, info

    def _random(self, index: int) -> np.random.BitGenerator:
        return self.simulation.generator(index).bit_generator

    def _ordered(self, observation: Observation) -> Observation:
        """Return the observation with its parts sorted by name, the order of the space."""
        return {name: observation[name] for name in sorted(observation)}

    def _rewards(self, result: StepResult) -> Array:
        """Return the rewards (N,) of a step, from `compute_reward` if it is overridden."""
        if not self.overrides('compute_reward'):
            return result.reward
        return np.asarray(self.compute_reward(*_evaluated(result)), dtype=np.float64)

    def _endings(self, name: str, result: StepResult) -> Flags:
        """Return a mask (N,) of episodes that method `name` ends; all False if not overridden."""
        if not self.overrides(name):
            return np.zeros(self.num_envs, dtype=bool)
        ends = getattr(self, name)(*_evaluated(result))
        flags = np.full(self.num_envs, ends) if isinstance(ends, bool) else np.asarray(ends)
        if flags.dtype != bool or flags.shape != (self.num_envs,):
            raise ValueError(
                f'{name} of a batch gives booleans of shape ({self.num_envs},), one for each '
                f'environment, not {ends!r:.60}'
            )
        return flags

    def _start_next(
        self, last: Observation, info: dict[str, Any], ended: Flags
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset the environments of the mask `ended`; return observations and infos of all N.

        For ended episodes, `last` becomes `final_obs` and `info` becomes `final_info`.
        """
        final = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(ended).tolist():
            final[index] = {name: rows[index] for name, rows in last.items()}
        values = {name: rows for name, rows in info.items() if not name.startswith('_')}
        observation = self.simulation.reset(ids=ended)
        self._elapsed[ended] = 0
        self._ended = np.zeros(self.num_envs, dtype=bool)
        return observation, {
            **_masked(_only(values, ~ended), ~ended),
            **_masked(
                {'final_obs': final, 'final_info': _masked(_only(values, ended), ended)}, ended
            ),
        }

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The random generators, no copies, of the N environments."""
        for index, seed in enumerate(self._seeds):
            if seed is None:
                # A generator that is read before the first episode also draws that episode.
                fresh, self._seeds[index] = seeding.np_random()
                self._random(index).state = fresh.bit_generator.state
        return tuple(self.simulation.generator(i) for i in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds of the N random generators, given or drawn; -1 while a generator has none."""
        return tuple(-1 if seed is None else seed for seed in self._seeds)

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of every environment; None without a render mode.

        Raises:
            RuntimeError: If there is no OpenGL, or if another thread rendered the first picture and
                the OpenGL backend does not allow that.
            gymnasium.error.ResetNeeded: If an environment was never reset.
        """
        if self.render_mode is None:
            return None
        if not self.simulation.is_started.all():
            raise gymnasium.error.ResetNeeded('reset the environments before render')
        return tuple(self._pictures.render(self.render_mode, i) for i in range(self.num_envs))

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method, or return an attribute, of every environment, as `SyncVectorEnv` does.

        Shared methods, such as `compute_reward`, are called once.

        Raises:
            AttributeError: If an environment has no such attribute.
            ValueError: For `reset`, `step` and `close`; call these directly.
        """
        if name in _FOR_ALL:
            raise ValueError(f'{name} is for all environments of a batch; use it directly')
        if name == 'render':
            return self.render() or (None,) * self.num_envs
        values = self.attributes(name)
        if name in _OF_EACH or not callable(values[0]):
            return values
        return (values[0](*args, **kwargs),) * self.num_envs

    def attributes(self, name: str) -> tuple[Any, ...]:
        """Return the attribute `name` of every environment; methods are returned, not called."""
        if name in _OF_EACH:
            return tuple(_OF_EACH[name](self))
        return (getattr(self, _SHARED.get(name, name)),) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute, or the result of a method, of every environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set `goal` of each environment, or an attribute that all share.

        Args:
            name: `goal`, `reward_type`, `distance_threshold` or `rotation_threshold`.
            values: One value for all, or a list or tuple with one for each.

        Raises:
            AttributeError: If there is no such attribute, or it cannot be set.
            ValueError: If the number of values is not `num_envs`, a goal is invalid, or the values
                of a shared attribute differ.
        """
        each = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise ValueError(f'{self.num_envs} environments take as many values, not {len(each)}')
        if name == 'goal':
            shape = (self.num_envs, self.spec_of_task.goal.size)
            self.simulation.goals[:] = finite_numbers(
                f'goals of {self.spec_of_task.name}', each, shape
            )
        elif name not in _SETTABLE:
            allowed = ', '.join(('goal', *_SETTABLE))
            raise AttributeError(f'{name!r} of a batch cannot be set; allowed: {allowed}')
        elif not all(np.array_equal(value, each[0]) for value in each):
            raise ValueError(f'the environments of a batch share {name}; given: {each}')
        else:
            setattr(self, name, each[0])

    def close_extras(self, **kwargs: Any) -> None:
        """Close the renderer."""
        self._pictures.close()

    def _each_seed(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Return `seed` as N seeds; where there never was one, replace None by a random seed."""
        if seed is None:
            each: list[int | None] = [None] * self.num_envs
        elif np.ndim(seed):  # type: ignore[arg-type]
            each = list(seed)  # type: ignore[arg-type]
        else:
            require_whole('seed', seed, highest=None)
            each = [int(seed) + i for i in range(self.num_envs)]  # type: ignore[arg-type]
        if len(each) != self.num_envs:
            raise ValueError(f'{self.num_envs} environments take as many seeds, not {len(each)}')
        return [
            seeding.np_random()[1] if new is None and old is None else new
            for new, old in zip(each, self._seeds, strict=True)
        ]

    def _reset_mask(self, options: Any) -> Flags:
        if not isinstance(options, dict) or 'reset_mask' not in options:
            return np.ones(self.num_envs, dtype=bool)
        mask = options['reset_mask']
        is_array = isinstance(mask, np.ndarray) and mask.dtype == bool
        if not is_array or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f'reset_mask {one_line(repr(mask), 60)}; allowed: an array of {self.num_envs} '
                'booleans, at least one of them True'
            )
        return np.asarray(mask)


_SETTABLE = ('reward_type', 'distance_threshold', 'rotation_threshold')
# Attributes of each environment.
_OF_EACH: dict[str, Callable[[FetchHandVectorEnv], Sequence[Any]]] = {
    'np_random': lambda batch: batch.np_random,
    'np_random_seed': lambda batch: batch.np_random_seed,
    'goal': lambda batch: list(batch.simulation.goals.copy()),
    'data': lambda batch: [batch.simulation.data(i) for i in range(batch.num_envs)],
}
# Methods that all environments of a batch run together.
_FOR_ALL = ('reset', 'step', 'close')
# Names of the single environment for what the batch calls otherwise.
_SHARED = {'action_space': 'single_action_space', 'observation_space': 'single_observation_space'}


def _evaluated(result: StepResult) -> tuple[Array, Array, dict[str, Any]]:
    """Return achieved and desired goals (N, goal size), and `is_success` and `diverged` as info."""
    info = {'is_success': result.success.astype(np.float64), 'diverged': result.diverged}
    return result.observation['achieved_goal'], result.observation['desired_goal'], info


def _masked(values: Mapping[str, Any], mask: Flags) -> dict[str, Any]:
    """Return `values`, and for each a copy of `mask` as `_<name>`, as in Gymnasium's infos."""
    return {**values, **{f'_{name}': mask.copy() for name in values}}


def _only(values: Mapping[str, NDArray[Any]], mask: Flags) -> dict[str, NDArray[Any]]:
    """Return copies of the values (N,) that are zero where `mask` is False."""
    return {name: np.where(mask, rows, np.zeros_like(rows)) for name, rows in values.items()}
