"""Films in memory, which a notebook plays and `save` writes."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit

from fetch_hand_sim.films.film import (
    MOVING,
    Roll,
    check_kind,
    check_size,
    write_animation,
    write_film,
)
from fetch_hand_sim.films.recording import Studio, load_recordings
from fetch_hand_sim.gym_envs.task_attributes import TaskAttributes
from msgs_spec.arrays import Picture

# Range of the pictures per second of a file; a GIF shows a picture for 655 s at most.
_RATES = (0.01, 1000.0)


class Film:
    """A film in memory. A notebook plays it as the result of a cell.

    Args:
        pictures: (height, width, 3) uint8, all of one size, as returned by `render`.
        fps: Pictures per second, 0.01 ... 1000.

    Raises:
        ValueError: If there are no pictures, or one has another size or type.
    """

    def __init__(self, pictures: Iterable[Picture], fps: float = 25.0) -> None:
        if not isinstance(fps, int | float | np.number):
            raise ValueError(f'fps {fps!r}; allowed: a number')
        if not _RATES[0] <= fps <= _RATES[1]:
            raise ValueError(f'fps {fps:g}; allowed: {_RATES[0]:g} ... {_RATES[1]:g}')
        self.fps = float(fps)
        self._roll = Roll()
        self._shape: tuple[int, ...] = ()
        for picture in pictures:
            self._add(picture)
        if not self._shape:
            raise ValueError('no pictures; allowed: one or more')

    @classmethod
    def of_episode(
        cls, path: str | Path, width: int = 640, height: int = 480, camera: str | None = None
    ) -> Film:
        """Return the film of a logged episode, or of the first episode in a folder.

        Args:
            path: An episode file, its folder, or a folder of several episodes.
            width: Pixels.
            height: Pixels.
            camera: Name of a camera of the model; None for the usual view.

        Raises:
            ValueError: If the episode cannot be read, or the model has no such camera.
            RuntimeError: Without OpenGL.
        """
        (recording,) = load_recordings(Path(path).expanduser(), count=1)
        studio = Studio(width, height, camera)
        try:
            return cls(studio.pictures(recording), recording.arrays.record.control_hz)
        finally:
            studio.close()

    def __len__(self) -> int:
        """Return the number of pictures."""
        return len(self._roll)

    def __iter__(self) -> Iterator[Picture]:
        """Yield the pictures, read-only."""
        return iter(self._roll)

    def save(self, path: str | Path) -> Path:
        """Write the film as .gif, .webp or .mp4 and return the path.

        Raises:
            ValueError: If suffix, folder or size is not allowed, or ffmpeg is missing for .mp4.
            OSError: If the file cannot be written.
        """
        file = Path(path).expanduser()
        if file.suffix.lower() not in MOVING:
            raise ValueError(f'a film ends in {", ".join(MOVING)}, not {file.name!r}')
        check_kind(file)
        check_size(file, self._shape[1], self._shape[0])
        write_film(file, self, self.fps)
        return file

    def __repr__(self) -> str:
        """Return a text with number and size of the pictures and the duration."""
        height, width = self._shape[:2]
        return f'Film({len(self)} pictures of {width}x{height}, {len(self) / self.fps:.1f} s)'

    def _repr_html_(self) -> str:
        """Return the film as HTML with embedded data, which notebooks show and save."""
        buffer = io.BytesIO()
        write_animation(buffer, self, self.fps, '.webp')
        data = base64.b64encode(buffer.getvalue()).decode()
        return f'<img alt="{self!r}" src="data:image/webp;base64,{data}">'

    def _add(self, picture: Picture) -> None:
        array = np.asarray(picture)
        is_picture = array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3
        if not is_picture or self._shape not in ((), array.shape):
            wanted = self._shape or '(height, width, 3)'
            raise ValueError(
                f'picture {len(self)} is {array.dtype} {array.shape}; allowed: uint8 {wanted}'
            )
        self._shape = array.shape
        self._roll.add(array)


def film_episode(env: gymnasium.Env[Any, Any], policy: Any, seed: int | None = None) -> Film:
    """Play one episode of an environment and return its film.

    An environment of this package without a time limit is filmed for `episode_ticks` steps.

    Args:
        env: Made with `render_mode='rgb_array'`.
        policy: A function from observation to action; or an object with
            `predict(observation, state, deterministic=True)`, like the models of Stable-Baselines3.
            `state` is the one that the last call returned; it is left out while it is None.
        seed: Seed of the reset; None continues the random generator.

    Raises:
        ValueError: If the environment does not render arrays, or the policy is invalid.
        RuntimeError: Without OpenGL.
    """
    if not isinstance(env, gymnasium.Env):
        raise ValueError(f'env {env!r:.60}; allowed: an environment, as make(...) gives it')
    if env.render_mode != 'rgb_array':
        raise ValueError(f"render_mode {env.render_mode!r}; allowed: 'rgb_array'")
    return Film(_played(env, _act(policy), seed), float(env.metadata.get('render_fps', 25)))


def _act(policy: Any) -> Callable[[Any], Any]:
    if hasattr(policy, 'predict'):
        state: Any = None

        def predict(observation: Any) -> Any:
            nonlocal state
            # A policy without memory may take no state.
            memory = {} if state is None else {'state': state}
            action, state = policy.predict(observation, **memory, deterministic=True)
            return action

        return predict
    if not callable(policy):
        raise ValueError(
            f'policy {policy!r:.60}; allowed: what has predict(observation, deterministic=True), '
            'as load_policy gives it, or a function from observation to action'
        )
    act: Callable[[Any], Any] = policy
    return act


def _played(
    env: gymnasium.Env[Any, Any], act: Callable[[Any], Any], seed: int | None
) -> Iterator[Picture]:
    observation, _ = env.reset(seed=seed)
    yield _rendered(env)
    steps = count() if (limit := _most_steps(env)) is None else range(limit)
    for _ in steps:
        observation, _, terminated, truncated, _ = env.step(act(observation))
        yield _rendered(env)
        if terminated or truncated:
            return


def _most_steps(env: gymnasium.Env[Any, Any]) -> int | None:
    """Return `episode_ticks` for an environment of this package without a time limit, else None."""
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeLimit):
            return None
        env = env.env
    return env.spec_of_task.episode_ticks if isinstance(env, TaskAttributes) else None


def _rendered(env: gymnasium.Env[Any, Any]) -> Picture:
    picture: Picture = env.render()  # type: ignore[assignment]
    return picture
