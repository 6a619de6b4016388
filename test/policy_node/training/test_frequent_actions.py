"""Collection of episodes, and methods for high action frequencies."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.tasks import task_spec
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.policies.policy import RestingPolicy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import from_flat, to_flat
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.collector import Collector
from policy_node.training.experience.replay import Episodes, Transitions
from policy_node.training.learners.actor_critic import network_shape
from policy_node.training.learners.ddpg import DDPG
from policy_node.training.machine import Workers
from policy_node.training.research.frequent_actions import (
    length_of,
    ticks_of,
)
from policy_node.training.research.registry import (
    make_collector,
    make_ddpg,
    make_sampler,
)

TICKS = 500


def config_at(control_hz: float, **changes: object) -> TrainConfig:
    """FetchReach in small: updates that move fast, targets that follow at once."""
    quick = {'precision': 'float32', 'target_update_interval': 1, 'polyak': 0.5}
    quick |= {'action_l2': 0.0, 'learning_rate': 3e-3}
    return recipe_config('FetchReach', 'best', control_hz=control_hz, **{**quick, **changes})


def learner_of(config: TrainConfig) -> DDPG:
    torch.manual_seed(0)
    return make_ddpg(NetworkShape(2, 1, 1, (32, 32)), config, torch.device('cpu'), Workers())


def batch_of(config: TrainConfig, action: np.ndarray, reward: np.ndarray) -> Transitions:
    """Transitions of one state that never changes."""
    count = len(action)
    state, goal = np.ones((count, 2), np.float32), np.ones((count, 1), np.float32)
    return Transitions(
        observation=state,
        next_observation=state,
        goal=goal,
        action=action.astype(np.float32),
        reward=(reward * config.tick_share).astype(np.float32),
        discount=np.full(count, config.tick_gamma, np.float32),
    )


@pytest.mark.parametrize(
    ('control_hz', 'discount', 'share', 'gamma'),
    [
        (250.0, 'tick', 1.0, 0.5),
        (250.0, 'time', 0.1, 0.5**0.1),
        (25.0, 'tick', 1.0, 0.5),
        (25.0, 'time', 1.0, 0.5),
    ],
)
def test_values_discount_ticks_or_time(
    control_hz: float, discount: str, share: float, gamma: float
) -> None:
    """The lowest value is of a state that is left never: -1 per tick or per 40 ms."""
    config = config_at(control_hz, gamma=0.5, discount=discount)
    assert (config.tick_share, config.tick_gamma) == pytest.approx((share, gamma))
    lower, end = torch.full((1,), -100.0), torch.zeros(1)
    lowest = learner_of(config).targets(lower, end, torch.zeros(1, 3))
    assert lowest.item() == pytest.approx(-share / (1.0 - gamma))
    sampler = make_sampler(config, GoalMetric(task_spec('FetchReach', control_hz=control_hz)))
    assert (sampler.reward_scale, sampler.gamma) == pytest.approx((share, gamma))


def actor_of(outputs: int, *hidden: int) -> Actor:
    torch.manual_seed(0)
    return Actor(NetworkShape(10, 3, outputs, hidden or (16,))).eval()


def collected(**options: object) -> Episodes:
    """An episode in each of eight simulations at 250 Hz, around an actor that rests."""
    simulation = Simulation('FetchReach', num_envs=8, num_threads=1, control_hz=250.0)
    actor = actor_of(4)
    torch.nn.init.zeros_(actor.network.output.weight)
    config = config_at(250.0, noise_std=0.2, random_epsilon=0.0, **options)
    return make_collector(simulation, list(range(8)), config).collect(actor)[0]


def test_noise_that_holds_for_40_ms_moves_the_gripper_as_at_25_hz() -> None:
    """Of n independent steps the sum is sqrt(n) of one: held for 10, sqrt(10) times as far."""
    free, held = (collected(noise_seconds=seconds) for seconds in (0.0, 0.04))
    assert held.action.shape == (8, TICKS, 4)
    blocks = held.action.reshape(8, TICKS // 10, 10, 4)
    assert (blocks == blocks[:, :, :1]).all()
    assert (blocks[:, 1:, 0] != blocks[:, :-1, 0]).all()
    assert (free.action[:, 1:] != free.action[:, :-1]).all()
    spread = [float(e.action.sum(axis=1).std()) for e in (free, held)]
    assert spread[1] / spread[0] == pytest.approx(np.sqrt(10.0), rel=0.35)


def test_noise_on_weights_moves_actions_as_far_as_asked():
    actor = actor_of(4, 64, 64)
    config = config_at(25.0, parameter_noise=True, noise_std=0.2, random_epsilon=0.0)
    simulation = Simulation('FetchReach', num_envs=8, num_threads=1)
    collector = make_collector(simulation, list(range(8)), config)
    for _ in range(5):
        episodes, _ = collector.collect(actor)
    goal = np.repeat(episodes.desired_goal[:, None], 50, axis=1)
    own, _ = actor.predict({'observation': episodes.observation[:, :-1], 'desired_goal': goal})
    assert np.sqrt(np.square(episodes.action - own).mean()) == pytest.approx(0.2, rel=0.3)


def test_lengths_mean_ticks_and_ticks_lengths() -> None:
    ticks = np.arange(1, 11)
    np.testing.assert_array_equal(ticks_of(length_of(ticks, 10), 10), ticks)
    np.testing.assert_array_equal(ticks_of(np.array([-1.0, 0.01, 1.0]), 3), [1, 2, 3])


@pytest.mark.parametrize('noise', [0.0, 0.3])
def test_held_actions_are_recorded_with_the_ticks_left(noise: float) -> None:
    """Two episodes in each of two simulations; without noise every decision is the actor's."""
    actor = actor_of(5)
    with torch.no_grad():
        # Lengths that differ from state to state.
        actor.network.output.weight.mul_(4.0)
    config = from_flat(
        {'task': 'FetchReach'}, longest_hold=6, noise_std=noise, random_epsilon=noise
    )
    simulation = Simulation('FetchReach', num_envs=2, num_threads=1)
    collector = make_collector(simulation, [3, 4], config)
    lengths: set[int] = set()
    for _ in range(2):
        episodes, _ = collector.collect(actor)
        for row in range(2):
            decided = decisions(episodes.action[row], 6)
            lengths |= set(np.diff([*decided, 50]))
            if noise == 0.0:
                goal = np.repeat(episodes.desired_goal[row : row + 1], len(decided), axis=0)
                asked = {'observation': episodes.observation[row, decided], 'desired_goal': goal}
                own, _ = actor.predict(asked)
                np.testing.assert_allclose(episodes.action[row, decided, :4], own[:, :4], atol=1e-5)
                wanted = np.minimum(ticks_of(own[:, 4], 6), 50 - np.array(decided))
                np.testing.assert_array_equal(np.diff([*decided, 50]), wanted)
    assert len(lengths) > 3


def decisions(action: np.ndarray, most: int) -> list[int]:
    """Ticks at which something was decided, which then held, to the end of the episode at most."""
    left, found, tick = ticks_of(action[:, -1], most), [], 0
    while tick < len(action):
        assert 1 <= left[tick] <= most
        held = slice(tick, tick + left[tick])
        assert left[held].tolist() == list(range(left[tick], 0, -1)), 'counted down to its end'
        assert (action[held, :-1] == action[tick, :-1]).all()
        found.append(tick)
        tick += left[tick]
    return found


def test_an_actor_with_lengths_is_saved_as_one_that_decides_at_every_tick() -> None:
    config = config_at(250.0, longest_hold=10)
    learner = make_ddpg(network_shape(config), config, torch.device('cpu'), Workers())
    collecting, plain = learner.acting_policy(), learner.evaluation_actor()
    state = {'observation': np.ones((3, 10)), 'desired_goal': np.ones((3, 3))}
    assert collecting.predict(state)[0].shape == (3, 5)
    np.testing.assert_allclose(
        plain.predict(state)[0], collecting.predict(state)[0][:, :4], atol=1e-6
    )


@pytest.mark.parametrize('control_hz', [pytest.param(25.0, marks=pytest.mark.release), 250.0])
def test_advantages_are_as_large_at_every_rate(control_hz: float) -> None:
    """Two arms: actions above 0 are rewarded with 0, others with -1 per 40 ms."""
    config = config_at(control_hz, gamma=0.5, discount='time', advantage=True)
    learner, generator = learner_of(config), np.random.default_rng(0)
    for _ in range(400):
        action = generator.choice([-0.9, 0.9], (64, 1))
        learner.update(batch_of(config, action, np.where(action[:, 0] > 0, 0.0, -1.0)))
    features = torch.ones(1, 3)
    best, worst = (
        learner.critic.advantage(features, torch.full((1, 1), value)).item()
        for value in (0.9, -0.9)
    )
    assert best - worst == pytest.approx(1.0, abs=0.15)
    assert learner.critic.value(features).item() == pytest.approx(0.0, abs=0.1)
    assert learner.actor(features).item() > 0.8


def test_the_best_recipe_counts_time_as_time_at_high_rates() -> None:
    def values(recipe: str, *names: str, **fields: object) -> list[object]:
        flat = to_flat(recipe_config('FetchPush', recipe, **fields))
        return [flat[name] for name in names]

    counts = ('total_steps', 'evaluate_every')
    usual = values('best', *counts)
    assert values('best', *counts, control_hz=250.0) == [10 * count for count in usual]
    names = ('discount', 'noise_seconds', 'n_step')
    assert values('best', *names, control_hz=250.0) == ['time', 0.04, 10]
    assert values('best', *names) == ['tick', 0.0, 1]
    own = values('best', *names, *counts, control_hz=250.0, longest_hold=5, total_steps=1000)
    assert own[:4] == ['tick', 0.0, 1, 1000]
    assert values('best', 'n_step', *counts, control_hz=12.5) == [1, *(n // 2 for n in usual)]
    paper = values('paper', 'n_step', *counts, control_hz=250.0)
    assert paper == values('paper', 'n_step', *counts)


def plain_collector(noise_std=0.2, random_epsilon=0.3, envs=4):
    simulation = Simulation('FetchReach', num_envs=envs, num_threads=1)
    config = from_flat({'task': 'FetchReach'}, noise_std=noise_std, random_epsilon=random_epsilon)
    return Collector(simulation, [10 * i for i in range(envs)], config)


def test_episodes_are_what_the_simulation_does_with_the_actions():
    collector = plain_collector()
    episodes, success = collector.collect(actor_of(4))
    assert (len(episodes), episodes.ticks) == (4, 50)
    simulation = Simulation('FetchReach', num_envs=4, num_threads=1)
    observation = simulation.reset(seed=[0, 10, 20, 30])
    reached = np.zeros(4, bool)
    for tick in range(50):
        expected = observation['observation'].astype(np.float32)
        np.testing.assert_array_equal(episodes.observation[:, tick], expected)
        result = simulation.step(episodes.action[:, tick])
        observation, reached = result.observation, result.success
    np.testing.assert_array_equal(
        episodes.achieved_goal[:, 50], observation['achieved_goal'].astype(np.float32)
    )
    np.testing.assert_array_equal(
        episodes.desired_goal, observation['desired_goal'].astype(np.float32)
    )
    assert success == reached.mean()
    following, _ = collector.collect(actor_of(4))
    assert (following.desired_goal != episodes.desired_goal).all(), 'later cycles have new goals'


@pytest.mark.parametrize('epsilon', [0.0, 0.3])
def test_noise_has_the_spread_and_the_share_asked_for(epsilon):
    episodes, _ = plain_collector(0.1, epsilon, envs=20).collect(RestingPolicy(4))
    actions = episodes.action.reshape(-1, 4)
    assert np.abs(actions).max() <= 1.0
    # Five standard deviations of the Gaussian; a uniform action stays inside with 0.5 ** 4.
    outside = (np.abs(actions) > 0.5).any(axis=1).mean()
    assert outside == pytest.approx(epsilon * (1 - 0.5**4), abs=0.04)
    inside = actions[(np.abs(actions) <= 0.5).all(axis=1)]
    assert inside.std() == pytest.approx(0.1, abs=0.012)
