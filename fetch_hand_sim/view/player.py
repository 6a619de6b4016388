"""Play episode files on a page, without ROS."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fetch_hand_sim.episode_log import EpisodeReadError
from fetch_hand_sim.films.recording import find_playable, load_recording, none_readable
from fetch_hand_sim.simulation.scene import trail_of
from fetch_hand_sim.view.curves import Curves
from fetch_hand_sim.view.page.page import Page
from fetch_hand_sim.view.picture import ONLY_WATCHED, Facts, Picture, Timeline
from fetch_hand_sim.view.requests import (
    ChangeEpisode,
    OpenEpisode,
    Request,
    Seek,
    SetPaused,
    SetSpeed,
    StepOnce,
)
from fetch_hand_sim.view.session import Requests, Session
from fetch_hand_sim.view.web import FrameRate, announce, open_page
from node_runtime.command_line import EXIT_SUCCESS, usage_errors
from node_runtime.node_main import StopSignals

# Seconds for which the last frame stays before the episode starts again.
_PAUSE_AT_END = 1.0
_FRAME_TIME = 1.0 / 60.0


def run_files(options: argparse.Namespace) -> int:
    """Play files until the user ends the program; return the exit code.

    Raises:
        UsageError: If no episode can be played.
        CommandError: If the page cannot be served.
    """
    stop = StopSignals()
    with usage_errors(EpisodeReadError):
        paths = find_playable(options.path)
        player = Player(paths, may_act=not options.read_only)
    plugins = [Page(tuple(paths)), Requests(player.perform)]
    handle, address = open_page(
        options.host, options.port, plugins, FrameRate(), is_read_only=options.read_only
    )
    with handle:
        if not stop:
            announce(address, options.browser)
        session = Session(handle, player.picture)
        while not stop:
            session.update()
            time.sleep(_FRAME_TIME)
    return EXIT_SUCCESS


class Player:
    """Plays one episode of a list: moves a playhead over its frames.

    Args:
        paths: Episodes, at least one.
        clock: A steady clock, seconds.
        may_act: Whether the page may pause, seek and open other episodes.

    Raises:
        EpisodeReadError: If no episode can be read.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        clock: Callable[[], float] = time.monotonic,
        may_act: bool = True,
    ) -> None:
        self._paths = list(paths)
        self._may_act = may_act
        self._clock = clock
        self._number = 0
        self._speed = 1.0
        self._is_paused = False
        self._position = 0.0
        self._then = clock()
        self._notice = ''
        self._shown: tuple[object, ...] = ()
        self._open_first(range(len(paths)))

    @property
    def index(self) -> int:
        """The index of the frame at the playhead."""
        times = self._recording.times
        return int(np.searchsorted(times, self._position + 1e-9, side='right')) - 1

    def picture(self) -> Picture | None:
        """Move the playhead to the present time; return a picture, or None if it is unchanged."""
        self._advance()
        now = (self._number, self.index, self._is_paused, self._speed, self._notice)
        if now == self._shown:
            return None
        self._shown = now
        return self._make_picture()

    def perform(self, request: Request) -> None:
        """Perform a playback request; show a notice instead if the page may only watch."""
        if not self._may_act:
            self._notice = ONLY_WATCHED
            return
        match request:
            case SetPaused():
                self._set_paused(request.is_paused)
            case SetSpeed():
                self._speed = request.factor
            case StepOnce():
                self._is_paused = True
                self._show(self.index + request.frames)
            case Seek():
                self._is_paused = True
                self._show(request.index)
            case ChangeEpisode(by=by):
                count = len(self._paths)
                self._change([(self._number + by * i) % count for i in range(1, count + 1)])
            case OpenEpisode(number=number) if 0 <= number < len(self._paths):
                self._change([number])

    def _set_paused(self, is_paused: bool) -> None:
        self._is_paused = is_paused
        if not is_paused and self.index == len(self._recording.frames) - 1:
            self._position = 0.0

    def _show(self, index: int) -> None:
        last = len(self._recording.frames) - 1
        self._position = float(self._recording.times[min(max(index, 0), last)])

    def _change(self, numbers: Sequence[int]) -> None:
        """Open the first readable episode of list positions `numbers`; show a notice if none is."""
        try:
            self._open_first(numbers)
        except EpisodeReadError as error:
            self._notice = str(error)

    def _open_first(self, numbers: Sequence[int]) -> None:
        """Open the first readable episode of list positions `numbers`; else EpisodeReadError."""
        skipped: list[EpisodeReadError] = []
        for number in numbers:
            try:
                self._open(number)
            except EpisodeReadError as error:
                skipped.append(error)
                continue
            if skipped:
                more = f' (and {len(skipped) - 1} more)' if len(skipped) > 1 else ''
                self._notice = f'skipped {skipped[0]}{more}'
            return
        raise none_readable(skipped)

    def _open(self, number: int) -> None:
        self._recording = recording = load_recording(self._paths[number])
        self._number, self._position, self._notice = number, 0.0, ''
        arrays = recording.arrays
        self._curves = Curves(recording.metric, length=len(recording.frames))
        for tick, frame in enumerate(recording.frames):
            step = tick - 1
            reward = float(arrays.rewards[step]) if tick else None
            command = arrays.commands[step] if tick else None
            self._curves.add(float(recording.times[tick]), frame, reward, command)

    def _advance(self) -> None:
        now = self._clock()
        elapsed, self._then = now - self._then, now
        if self._is_paused:
            return
        self._position += self._speed * elapsed
        if self._position > self._recording.times[-1] + _PAUSE_AT_END * self._speed:
            self._position = 0.0

    def _make_picture(self) -> Picture:
        recording, index = self._recording, self.index
        arrays = recording.arrays
        return Picture(
            task=recording.spec.name,
            frame=recording.frames[index],
            trail=tuple(trail_of(recording.frames, index)),
            facts=self._facts(index),
            graphs=self._curves.graphs(index + 1),
            command=arrays.commands[index - 1] if index else None,
            timeline=Timeline(
                time=float(recording.times[index]),
                title=recording.title,
                number=self._number,
                count=len(self._paths),
            ),
        )

    def _facts(self, index: int) -> Facts:
        arrays = self._recording.arrays
        return Facts(
            source='file',
            episode=arrays.record.episode,
            seed=arrays.record.seed,
            tick=index,
            ticks=len(arrays),
            episode_return=float(arrays.rewards[:index].sum()),
            commander='as logged',
            is_paused=self._is_paused,
            speed=self._speed,
            notice=self._notice,
            may_command=self._may_act,
        )
