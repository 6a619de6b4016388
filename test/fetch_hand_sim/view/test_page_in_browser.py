"""The page as people see it, in a real headless Chromium: `make test-browser`, `make test-release`.

`VIEW_SCREENSHOTS=docs/images/view` keeps what was seen.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from fetch_hand_sim.episode_log import EpisodeDirectory
from fetch_hand_sim.episode_log.arrays import load_episode
from fetch_hand_sim.simulation.scene import Scene
from fetch_hand_sim.view.page.ray import MousePlace, mouse_ray
from msgs_spec.codecs import TopicCodec, decode
from msgs_spec.tasks import TASKS
from msgs_spec.topics import topic
from support.browser import SIZE, Browser, find_browser
from support.episode_recorder import Recorder
from support.graph import Client, client, ros_args

pytestmark = [
    pytest.mark.skipif(find_browser() is None, reason='no Chromium: apt install chromium'),
    # A browser is slow, and slower beside other tests.
    pytest.mark.release,
    pytest.mark.alone,
    pytest.mark.timeout(1500),
]

VIEW = (sys.executable, '-m', 'fetch_hand_sim.view')
# Height of the bar below the scene, pixels.
BAR = 32
# Seconds in which a page changes: a machine without a GPU that does other things too is slow.
PATIENCE = 180.0
# Of a list.
ROW = 18.0


@pytest.fixture
def browser():
    browser = Browser()
    yield browser
    browser.close()


def address_of(process: subprocess.Popen[str]) -> str:
    """Wait for the line with the address of the page; return the address."""
    for line in process.stdout:
        if found := re.search(r'http://\S+', line):
            return found[0]
    raise AssertionError(process.communicate()[1])


def keep(name: str, picture: np.ndarray) -> None:
    if folder := os.environ.get('VIEW_SCREENSHOTS'):
        Path(folder).mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(Path(folder) / f'{name}.jpg', quality=82)


def wait_for_scene(browser: Browser, seconds: float = PATIENCE) -> np.ndarray:
    """Waits until there is something in the middle of the page."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        browser.wait(1.0)
        picture = browser.screenshot()
        if picture[150:500, 380:560].std() > 12.0:
            browser.wait(2.0)
            return browser.screenshot()
    raise AssertionError('nothing is drawn')


def wait_for(browser: Browser, condition: Callable[[np.ndarray], bool], what: str) -> np.ndarray:
    """Waits until the page looks as it should; returns what it then looks like."""
    end = time.monotonic() + PATIENCE
    while not condition(picture := browser.screenshot()):
        if time.monotonic() > end:
            keep(f'without {what}', picture)
            raise AssertionError(f'no {what}')
        browser.wait(0.5)
    return picture


def wait_until_still(browser: Browser, part: tuple[slice, slice]) -> np.ndarray:
    """Wait until a part of the page stops moving; return the last picture."""
    pictures = [browser.screenshot()]

    def is_still(picture: np.ndarray) -> bool:
        pictures.append(picture)
        return len(pictures) > 4 and all(
            difference(picture[part], each[part]) < 0.001 for each in pictures[-4:]
        )

    return wait_for(browser, is_still, 'rest')


def place_of(task: str, point: np.ndarray) -> tuple[float, float]:
    """Where a point of the world is on the page, pixels."""
    width, height = SIZE[0], SIZE[1] - BAR
    ray = mouse_ray(Scene(task).view, 45.0, MousePlace(0.5, 0.5, width / height))
    offset = point - ray.origin
    depth = offset @ ray.forward
    half = np.tan(np.radians(45.0) / 2.0)
    x, y = offset @ ray.right / depth / half, offset @ ray.up / depth / half
    return width / 2 + x * height / 2, height / 2 - y * height / 2


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """The share of values in which two pictures differ by more than smoothing and dithering do."""
    return float((np.abs(first.astype(int) - second) > 30).mean())


def is_red(pixel: np.ndarray) -> bool:
    return pixel[0] > 110 and pixel[0] > 1.3 * max(pixel[1], pixel[2])


def is_green(pixel: np.ndarray) -> bool:
    return pixel[1] > 70 and pixel[1] > 1.3 * max(pixel[0], pixel[2])


def is_goal(pixel: np.ndarray) -> bool:
    return is_red(pixel) or is_green(pixel)


def is_blue(pixel: np.ndarray) -> bool:
    return pixel[2] > 60 and pixel[2] > 1.3 * max(pixel[0], pixel[1])


def is_white(pixel: np.ndarray) -> bool:
    return pixel.min() > 170 and np.ptp(pixel) < 40


# Column and row of pixels inside the elbow, forearm and wrist of a resting Fetch, with the colours
# of these links in the model; the forearm is where light falls.
LINKS = {(472, 116): is_blue, (496, 168): is_white, (528, 224): is_blue}
# On the table, below these links.
GOAL_ASIDE = np.array([1.4, 0.75, 0.43])


def headers(picture: np.ndarray) -> list[float]:
    """Where headers and chosen rows of the panels on the left are, from above, in any theme."""
    column = picture[40:500, 325].astype(int)
    colors, counts = np.unique(column, axis=0, return_counts=True)
    is_panel = (np.abs(column - colors[counts.argmax()]) < 4).all(axis=1)
    same = (np.abs(np.diff(column, axis=0)) < 4).all(axis=1) & ~is_panel[1:]
    same[np.flatnonzero(is_panel).max() - 1 :] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same, [0]])))
    runs = edges.reshape(-1, 2)
    return [41.0 + (start + end) / 2.0 for start, end in runs if 12 < end - start < 26]


def click_until(
    browser: Browser, x: float, y: float, condition: Callable[[np.ndarray], bool], what: str
) -> None:
    """Clicks until the page looks as it should; a page that is still busy may miss a click."""
    for _ in range(3):
        browser.click(x, y)
        end = time.monotonic() + PATIENCE / 6
        while time.monotonic() < end:
            browser.wait(1.0)
            if condition(picture := browser.screenshot()):
                return
    keep(f'without {what}', picture)
    raise AssertionError(f'no {what} after clicks at {x}, {y}')


def open_section(browser: Browser, header: float, before: np.ndarray) -> None:
    below = slice(round(header) + 12, round(header) + 32), slice(10, 340)

    def is_open(picture: np.ndarray) -> bool:
        return bool((np.abs(picture[below].astype(int) - before[below]) > 8).mean() > 0.05)

    click_until(browser, 120.0, header, is_open, 'section')


SIM_NODE = (
    *(sys.executable, '-m', 'fetch_hand_sim.sim_node'),
    *ros_args(task='FetchReach', perturb_limit=50.0),
)


@pytest.fixture
def robot_process(start_process):
    return start_process(*SIM_NODE)


@pytest.fixture
def robot(robot_process):
    """A client of a robot without a commander; every visitor may push it."""
    with client(TASKS['FetchReach']) as connection:
        connection.subscribe(
            'desired_goal', 'episode_status', 'achieved_goal', 'applied_command', 'joint_states'
        )
        connection.spin_until(lambda: connection.received['desired_goal'], 'a goal')
        yield connection


def latest(connection: Client, name: str) -> np.ndarray:
    # Nothing is served while a browser is waited for, so it may be the first to be.
    connection.spin_until(lambda: connection.received[name], name, PATIENCE)
    return decode(topic(connection.spec, name), connection.received[name][-1])


def pause_with_goal(robot: Client, goal: np.ndarray) -> None:
    """Moves the goal and pauses the robot before an episode gives it another."""
    from std_srvs.srv import SetBool

    target = topic(robot.spec, 'set_goal')
    robot.connect('set_goal')

    def is_there() -> bool:
        robot.publisher('set_goal').publish(TopicCodec(target).encode(0, goal))
        return np.allclose(latest(robot, 'desired_goal'), goal)

    robot.spin_until(is_there, 'goal in view')
    robot.call(SetBool, '/sim_node/pause', data=True)


def wait_for_moves(connection: Client, moves: list[float]) -> None:
    """Wait until the applied command has these first three components."""
    connection.spin_until(
        lambda: np.allclose(latest(connection, 'applied_command')[:3], moves),
        f'moves {moves}',
        PATIENCE,
    )


def test_files_are_listed_and_opened_and_the_timeline_moves_them(browser, start_process, tmp_path):
    recorder = Recorder('FetchPush')
    paths = [recorder.record(EpisodeDirectory(tmp_path)) for _ in range(8)]
    goals = [load_episode(path).goals[0] for path in paths]
    places = [place_of('FetchPush', goal) for goal in goals]
    # An episode whose goal is under no panel and not at the goal of the first one.
    number = next(
        number
        for number, (x, y) in enumerate(places)
        if 370.0 < x < 590.0 and np.hypot(x - places[0][0], y - places[0][1]) > 40.0
    )
    url = address_of(start_process(*VIEW, tmp_path))
    browser.open(url)
    keep('file', wait_for_scene(browser))
    hosts = {urlsplit(each).netloc for each in browser.requests()}
    assert hosts == {urlsplit(url).netloc}
    picture = wait_for(browser, lambda picture: len(headers(picture)) == 1, 'list')
    (first,) = headers(picture)
    x, y = (round(value) for value in places[number])
    assert not is_goal(picture[y, x])
    browser.click(100.0, first + ROW * number)
    wait_for(browser, lambda picture: is_goal(picture[y, x]), 'goal of that episode')
    keep('list', browser.screenshot())
    # The slider pauses at the frame that is clicked.
    y = SIZE[1] - BAR - 38.0
    scene = np.s_[120:500, 350:600]
    browser.click(60.0, y)
    early = wait_until_still(browser, scene)

    def is_later(picture: np.ndarray) -> bool:
        return difference(picture[scene], early[scene]) > 0.005

    click_until(browser, 880.0, y, is_later, 'later frame')


def test_a_robot_is_pulled_with_control_and_the_mouse(browser, start_process, robot):
    browser.open(address_of(start_process(*VIEW)))
    wait_for_scene(browser)
    # There are no commands, so it rests.
    robot.spin_until(lambda: robot.received['achieved_goal'], 'gripper')
    rest = latest(robot, 'achieved_goal')
    x, y = place_of('FetchReach', rest)
    browser.move(x, y)
    browser.press_key('Control')
    browser.press(x, y)
    # The page takes the body under the mouse when it draws its next frame.
    browser.wait(4.0)
    browser.wait_for_frames(8)
    for step in range(1, 9):
        browser.move(x + 8.0 * step, y - 8.0 * step, pressed=True)

    def is_pulled():
        return np.linalg.norm(latest(robot, 'achieved_goal') - rest) > 2e-3

    robot.spin_until(is_pulled, 'gripper that gives way', PATIENCE)
    keep('pulled', browser.screenshot())
    browser.release(x + 64.0, y - 64.0)
    browser.release_key('Control')
    # At the latest the next episode has no push.
    robot.spin_until(
        lambda: np.linalg.norm(latest(robot, 'achieved_goal') - rest) < 5e-4,
        'gripper at rest',
        PATIENCE,
    )


def take_over(browser: Browser, robot: Client) -> tuple[float, float]:
    """Lets the page command; returns where it is switched on and off."""
    wait_for_scene(browser)
    picture = wait_for(browser, lambda picture: len(headers(picture)) == 3, 'panel')
    _goal, commands, _push = headers(picture)
    open_section(browser, commands, picture)
    switch = 25.0, commands + 22.0
    switch_on(browser, robot, switch)
    return switch


def switch_on(browser: Browser, robot: Client, switch: tuple[float, float]) -> None:
    """Clicks until the page commands; a page that is still busy may miss a click."""
    for _ in range(3):
        browser.click(*switch)
        end = time.monotonic() + PATIENCE / 3
        while time.monotonic() < end:
            robot.spin(0.1)
            if robot.node.count_publishers('/commands') == 1:
                return
    keep('without commands', browser.screenshot())
    raise AssertionError('no page that commands')


def wait_for_no_commander(robot: Client) -> None:
    robot.spin_until(
        lambda: robot.node.count_publishers('/commands') == 0,
        'page that commands no more',
        PATIENCE,
    )


def test_arrow_keys_command_until_the_robot_is_another(
    browser, start_process, robot_process, robot
):
    browser.open(address_of(start_process(*VIEW)))
    switch = take_over(browser, robot)
    wait_for_moves(robot, [0.0, 0.0, 0.0])
    for key, wanted in (('ArrowRight', 1.0), ('ArrowLeft', -1.0)):
        browser.press_key(key)
        wait_for_moves(robot, [wanted, 0.0, 0.0])
        browser.release_key(key)
        wait_for_moves(robot, [0.0, 0.0, 0.0])
    browser.press_key('ArrowDown')
    browser.release_key('ArrowDown')
    browser.press_key('ArrowRight')
    wait_for_moves(robot, [0.0, 1.0, 0.0])
    keep('keys', browser.screenshot())
    browser.release_key('ArrowRight')
    browser.click(*switch)
    wait_for_no_commander(robot)
    switch_on(browser, robot, switch)
    robot_process.kill()
    robot_process.wait()
    wait_for_no_commander(robot)
    robot.received['joint_states'].clear()
    start_process(*SIM_NODE)
    robot.spin_until(lambda: len(robot.received['joint_states']) > 25, 'new robot', PATIENCE)
    browser.wait(2.0)
    robot.spin(2.0)
    assert robot.node.count_publishers('/commands') == 0
    assert np.allclose(latest(robot, 'applied_command'), 0.0)


def test_a_hidden_page_stops_commanding_the_robot(browser, start_process, robot):
    """The next visitor starts anew, not from the settings of the first one."""
    address = address_of(start_process(*VIEW))
    browser.open(address)
    take_over(browser, robot)
    browser.press_key('ArrowRight')
    wait_for_moves(robot, [1.0, 0.0, 0.0])
    # As long as it is seen, silence is a hand that holds still.
    robot.spin(8.0)
    wait_for_moves(robot, [1.0, 0.0, 0.0])
    assert robot.node.count_publishers('/commands') == 1
    browser.call('Page.setWebLifecycleState', state='frozen')
    wait_for_no_commander(robot)
    browser.close()
    with closing(Browser()) as next_one:
        next_one.open(address)
        wait_for_scene(next_one)
        next_one.wait_for_frames(10)
        robot.spin(1.0)
        assert robot.node.count_publishers('/commands') == 0


def test_dragging_the_goal_moves_it_and_the_actor_gets_there(browser, start_process, robot):
    from std_srvs.srv import SetBool

    url = address_of(start_process(*VIEW))
    browser.open(url)
    wait_for_scene(browser)
    # In front of the robot in the view of the camera.
    goal = np.array([1.45, 0.6, 0.65])
    pause_with_goal(robot, goal)
    x, y = place_of('FetchReach', goal)
    wait_for(browser, lambda picture: is_red(picture[round(y), round(x)]), 'goal on the page')
    for offset in (3.0, 0.0):
        browser.move(x + offset, y)
        browser.wait(0.5)
    browser.press(x, y)
    browser.wait(4.0)
    browser.wait_for_frames(8)
    for step in range(1, 11):
        browser.move(x + 6.0 * step, y - 5.0 * step, pressed=True)
    browser.release(x + 60.0, y - 50.0)
    robot.call(SetBool, '/sim_node/pause', data=False)
    robot.spin_until(
        lambda: np.linalg.norm(latest(robot, 'desired_goal') - goal) > 0.03,
        'a goal that moved',
        PATIENCE,
    )
    moved = latest(robot, 'desired_goal')
    wanted = np.array([x + 60.0, y - 50.0])
    assert np.abs(np.array(place_of('FetchReach', moved)) - wanted).max() < 4.0
    # New episodes keep it, so the actor has the time it needs.
    start_process(sys.executable, '-m', 'policy_node.node')
    robot.spin_until(
        lambda: (
            np.linalg.norm(latest(robot, 'desired_goal') - moved) < 1e-6
            and np.linalg.norm(latest(robot, 'achieved_goal') - moved) < 0.05
        ),
        'gripper at the dragged goal',
        PATIENCE,
    )
    browser.wait(1.0)
    keep('dragged', browser.screenshot())


def has_blue_parts(picture: np.ndarray) -> bool:
    pixels = picture[:-BAR:4, ::4].reshape(-1, 3).astype(int)
    return sum(bool(is_blue(pixel)) for pixel in pixels) > 20


def test_the_robot_is_where_it_stands_and_a_second_visitor_sees_it(browser, start_process, robot):
    pause_with_goal(robot, GOAL_ASIDE)

    def is_robot(picture: np.ndarray) -> bool:
        return all(is_color(picture[y, x].astype(int)) for (x, y), is_color in LINKS.items())

    url = address_of(start_process(*VIEW))
    browser.open(url)
    wait_for(browser, is_robot, 'robot in its colours')
    with closing(Browser()) as watcher:
        watcher.open(url)
        # From a camera of its own.
        keep('watched', wait_for(watcher, has_blue_parts, 'robot for who watches'))
