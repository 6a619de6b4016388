"""`make pictures`: the film of the README and a picture of every task, from logged episodes.

The shipped actor of each task plays a few episodes, which are logged and drawn. Without an actor,
commands are random; the picture names them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fetch_hand_sim.commands.node_processes import is_actor_shipped
from fetch_hand_sim.films.film import write_film, write_picture
from fetch_hand_sim.films.recording import Recording, load_recordings, sheet_size, tile, with_edge
from fetch_hand_sim.simulation.rendering import SceneRenderer
from fetch_hand_sim.simulation.scene import Scene, trail_of
from msgs_spec.arrays import Picture
from msgs_spec.tasks import TASKS
from node_runtime.command_line import progress
from policy_node.training.generate_episodes import main as generate_episodes

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / 'docs' / 'images'
FILM = IMAGES / 'family.webp'
COLUMNS = 5
TILE = (288, 216)
STILL = (960, 720)
# Pictures are drawn this many times larger and scaled down, which smooths edges.
OVERSAMPLING = 2
SHADOW_SIZE = 8192
# Every second tick; episodes of the Fetch tasks last half as long as those of the hand.
STEP = 2
FRAMES = 51
EPISODES = 16
CAPTION = '13 tasks of the Fetch arm and the Shadow hand'
# Cameras closer than the usual view: point looked at (m), distance (m), elevation (degrees). The
# first name that is part of the task's name counts.
CLOSE = {
    'FetchSlide': {'lookat': (1.4, 0.75, 0.48), 'distance': 1.8, 'elevation': -26.0},
    'Fetch': {'lookat': (1.27, 0.75, 0.55), 'distance': 1.25, 'elevation': -24.0},
    'HandReach': {'lookat': (1.01, 0.88, 0.2), 'distance': 0.31},
    'Pen': {'lookat': (1.04, 0.87, 0.21), 'distance': 0.44},
    'Hand': {'lookat': (1.04, 0.87, 0.21), 'distance': 0.38},
}


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


class Camera:
    """Draws recordings of one task close up, with smooth edges.

    Args:
        task: Task name.
        size: Width and height of a picture, pixels.
    """

    def __init__(self, task: str, size: tuple[int, int]) -> None:
        scene = Scene(task)
        scene.model.vis.quality.shadowsize = SHADOW_SIZE
        close = next(name for name in CLOSE if name in task)
        self._size = size
        width, height = (OVERSAMPLING * side for side in size)
        self._renderer = SceneRenderer(scene, width, height, CLOSE[close])

    def picture(self, recording: Recording, index: int) -> Picture:
        """Return the picture of one frame."""
        index %= len(recording.frames)
        trail = trail_of(recording.frames, index)
        large = Image.fromarray(self._renderer.render(recording.frames[index], trail))
        return np.asarray(large.resize(self._size, Image.Resampling.LANCZOS))

    def close(self) -> None:
        """Free OpenGL."""
        self._renderer.close()


def still(act: Act, task: str) -> Picture:
    """Return a picture of a frame in which the goal is reached, if there is one."""
    recording = act.recordings[0]
    reached = np.flatnonzero(recording.arrays.success)
    camera = Camera(task, STILL)
    picture = camera.picture(recording, int(reached[len(reached) // 2]) if len(reached) else -1)
    camera.close()
    return picture


def play(camera: Camera, act: Act) -> Iterator[Picture]:
    """Yields the tile's pictures, with its text and a green frame at the goal."""
    for recording in act.recordings:
        for index in range(0, len(recording.frames), STEP):
            picture = camera.picture(recording, index)
            if recording.frames[index].is_success:
                picture = with_edge(picture)
            yield labelled(picture, act.text)


def labelled(picture: Picture, text: str) -> Picture:
    """Writes a light line on a dark bar along the lower edge."""
    image = Image.fromarray(picture)
    draw, font = ImageDraw.Draw(image, 'RGBA'), ImageFont.load_default(size=15)
    draw.rectangle(
        (3, image.height - 27, image.width - 4, image.height - 4), fill=(20, 25, 35, 190)
    )
    draw.text((10, image.height - 25), text, fill=(255, 255, 255), font=font)
    return np.asarray(image)


def caption(count: int) -> Picture:
    """Return the text that fills the last row beside the tiles."""
    free = -count % COLUMNS
    width, height = sheet_size(free, free, *TILE)
    image = Image.new('RGB', (width, height), (20, 25, 35))
    draw = ImageDraw.Draw(image)
    lines = ['fetch_hand_sim', CAPTION, 'Trained policies; simulated time: 2 s and 4 s per episode']
    for number, (line, size) in enumerate(zip(lines, (34, 19, 15), strict=True)):
        draw.text(
            (width // 2, height // 2 + (number - 1) * 42),
            line,
            fill=(235, 240, 245),
            font=ImageFont.load_default(size=size),
            anchor='mm',
        )
    return np.asarray(image)


def film(acts: Mapping[str, Act]) -> Iterator[Picture]:
    """Yields the sheets of the film."""
    cameras = [Camera(task, TILE) for task in acts]
    players = [play(camera, act) for camera, act in zip(cameras, acts.values(), strict=True)]
    text = caption(len(acts)) if len(acts) % COLUMNS else None
    with progress('film', FRAMES) as advance:
        for _ in range(FRAMES):
            sheet = tile([next(player) for player in players], COLUMNS)
            if text is not None:
                sheet[-text.shape[0] :, -text.shape[1] :] = text
            yield sheet
            advance(1)
    for camera in cameras:
        camera.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--tasks', nargs='+', choices=list(TASKS), default=list(TASKS))
    parser.add_argument('--no-film', action='store_true', help='only the pictures of the tasks')
    options = parser.parse_args(arguments)
    (IMAGES / 'tasks').mkdir(parents=True, exist_ok=True)
    acts = {}
    with tempfile.TemporaryDirectory(prefix='pictures_') as folder:
        for task in options.tasks:
            acts[task] = make_act(task, Path(folder))
            write_picture(IMAGES / 'tasks' / f'{task}.jpg', still(acts[task], task))
    if not options.no_film:
        write_film(FILM, film(acts), fps=25.0 / STEP)
    size = sum(path.stat().st_size for path in IMAGES.rglob('*') if path.is_file())
    print(f'{IMAGES.relative_to(ROOT)}: {size / 1024:.0f} KiB')


if __name__ == '__main__':
    main()
