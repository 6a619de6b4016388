"""`make pictures`: the film of the README and a picture of every task, from logged episodes.

The shipped actor of each task plays a few episodes, which are logged and drawn. Without an actor,
commands are random; the picture names them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fetch_hand_sim.commands.node_processes import is_actor_shipped
from fetch_hand_sim.films.film import write_film, write_picture
from fetch_hand_sim.films.recording import Recording, load_recordings
from fetch_hand_sim.films.studio import Studio, tile, with_edge
from msgs_spec.arrays import Picture
from msgs_spec.tasks import TASKS
from node_runtime.command_line import progress
from policy_node.training.generate_episodes import main as generate_episodes

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / 'docs' / 'images'
FILM = IMAGES / 'family.webp'
COLUMNS = 5
TILE = (224, 168)
STILL = (480, 360)
# Every second tick; episodes of the Fetch tasks last half as long as those of the hand.
STEP = 2
FRAMES = 51
EPISODES = 16
# When most is to be seen of an episode: the share of its ticks.
MOMENT = 0.4


@dataclass(frozen=True)
class Act:
    """Content of one tile: consecutive episodes and a line of text."""

    recordings: list[Recording]
    text: str


def log_episodes(task: str, folder: Path) -> list[Recording]:
    """Log episodes of the shipped actor, or of random commands."""
    policy = task if is_actor_shipped(task) else 'random'
    arguments = ['--task', task, '--policy', policy, '--episodes', str(EPISODES)]
    code = generate_episodes([*arguments, '--num-envs', '16', '--output', str(folder / task)])
    if code:
        raise SystemExit(code)
    return load_recordings(folder / task, EPISODES)


def is_worth_showing(recording: Recording) -> bool:
    """Return whether the robot reaches the goal after the first tenth of the episode."""
    success = recording.arrays.success
    return bool(success[-1]) and not bool(success[: len(success) // 10].any())


def make_act(task: str, folder: Path) -> Act:
    """Chooses what is shown of a task."""
    recordings = log_episodes(task, folder)
    shown = sorted(recordings, key=lambda recording: not is_worth_showing(recording))
    needed = -(-STEP * FRAMES // len(shown[0].frames))
    note = '' if is_actor_shipped(task) else '  (no actor yet)'
    return Act(shown[:needed], f'{task.removeprefix("HandManipulate")}{note}')


def play(studio: Studio, act: Act) -> Iterator[Picture]:
    """Yields the tile's pictures, with its text and a green frame at the goal."""
    for recording in act.recordings:
        for index in range(0, len(recording.frames), STEP):
            picture = studio.picture(recording, index)
            if recording.frames[index].is_success:
                picture = with_edge(picture)
            yield labelled(picture, act.text)


def labelled(picture: Picture, text: str) -> Picture:
    """Writes a line into the upper left corner."""
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text(
        (8, 6), text, fill=(30, 35, 45), font=ImageFont.load_default(size=13)
    )
    return np.asarray(image)


def film(acts: Sequence[Act]) -> Iterator[Picture]:
    """Yields the sheets of the film."""
    studio = Studio(*TILE)
    players = [play(studio, act) for act in acts]
    with progress('film', FRAMES) as advance:
        for _ in range(FRAMES):
            yield tile([next(player) for player in players], COLUMNS)
            advance(1)
    studio.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--tasks', nargs='+', choices=list(TASKS), default=list(TASKS))
    parser.add_argument('--no-film', action='store_true', help='only the pictures of the tasks')
    options = parser.parse_args(arguments)
    (IMAGES / 'tasks').mkdir(parents=True, exist_ok=True)
    studio = Studio(*STILL)
    with tempfile.TemporaryDirectory(prefix='pictures_') as folder:
        acts = []
        for task in options.tasks:
            act = make_act(task, Path(folder))
            acts.append(act)
            moment = round(MOMENT * len(act.recordings[0].frames))
            write_picture(
                IMAGES / 'tasks' / f'{task}.jpg', studio.picture(act.recordings[0], moment)
            )
    studio.close()
    if not options.no_film:
        write_film(FILM, film(acts), fps=25.0 / STEP)
    size = sum(path.stat().st_size for path in IMAGES.rglob('*') if path.is_file())
    print(f'{IMAGES.relative_to(ROOT)}: {size / 1024:.0f} KiB')


if __name__ == '__main__':
    main()
