"""PPO and goals in hindsight: densities, advantages, weights, and a problem with a known answer."""

from __future__ import annotations

import itertools
import math
from dataclasses import fields

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.tasks import task_spec
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Episodes, Starts
from policy_node.training.machine import Workers
from policy_node.training.research.ppo import PPO, RolloutTransitions, log_probability
from policy_node.training.research.registry import make_learner
from policy_node.training.research.rollouts import (
    Outcomes,
    RolloutMaker,
    advantages,
    decision_weights,
    goals_in_hindsight,
)

ON_POLICY = {'algorithm': 'ppo', 'overlap': False, 'random_epsilon': 0.0, 'noise_std': 0.3}


def configured(**changes: object) -> TrainConfig:
    return recipe_config('FetchReach', 'best', **{**ON_POLICY, **changes})


def make_ppo(config: TrainConfig, *sizes: int, hidden: tuple[int, ...] = (32, 32)) -> PPO:
    """A learner for observations, goals and actions of these sizes."""
    torch.manual_seed(0)
    return PPO(NetworkShape(*sizes, hidden), config, torch.device('cpu'), Workers())


def test_densities_of_several_parts_multiply_and_have_gradients_beyond_the_limits() -> None:
    mean = torch.tensor([[0.2, 5.0]], requires_grad=True)
    action = torch.tensor([[0.5, -1.0]])
    both = log_probability(mean, 0.3, action)
    parts = [log_probability(mean[:, i : i + 1], 0.3, action[:, i : i + 1]) for i in range(2)]
    torch.testing.assert_close(both, parts[0] + parts[1])
    (gradient,) = torch.autograd.grad(both.sum(), mean)
    assert torch.isfinite(both).all() and torch.isfinite(gradient).all()
    assert gradient[0, 0] > 0 > gradient[0, 1]


def test_the_weight_of_an_action_is_the_product_of_all_ratios_so_far() -> None:
    log_ratio = np.random.default_rng(0).normal(size=(50, 3))
    product = np.cumprod(np.exp(log_ratio), axis=1)
    np.testing.assert_allclose(decision_weights(log_ratio), product / product.mean(axis=0))


def test_advantages_of_actions_for_another_goal_are_right_on_average_at_any_trace() -> None:
    """Three steps of two actions, all eight ways enumerated; every way is a state of its own."""
    generator = np.random.default_rng(0)
    ways = np.array(list(itertools.product((0, 1), repeat=3)))
    # By the actions before: the probabilities of both actions for either goal, and the reward.
    done = [ways[:, :tick] @ (1 << np.arange(tick)) + (1 << tick) for tick in range(4)]
    wanted, meant = (generator.uniform(0.2, 0.8, 8) for _ in range(2))

    def probabilities(of_one: np.ndarray) -> np.ndarray:
        ones = np.stack([of_one[done[tick]] for tick in range(3)], axis=1)
        return np.where(ways == 1, ones, 1.0 - ones)

    by_goal, by_other = probabilities(wanted), probabilities(meant)
    reward = np.stack([generator.normal(size=16)[done[tick + 1]] for tick in range(3)], axis=1)
    value = np.zeros((8, 4))
    exact = np.zeros((8, 3))
    for tick in reversed(range(3)):
        exact[:, tick] = reward[:, tick] + 0.9 * value[:, tick + 1]
        for state in np.unique(done[tick]):
            here = done[tick] == state
            later = by_goal[here, tick:].prod(axis=1)
            value[here, tick] = (later * exact[here, tick]).sum() / later.sum()
    ratio = by_goal / by_other
    for trace in (0.0, 0.5, 1.0):
        found = advantages(reward, value, 0.9, trace, np.log(ratio))
        weighed = by_other.prod(axis=1)[:, None] * np.cumprod(ratio, axis=1) * found
        for tick in range(3):
            for state in np.unique(done[tick + 1]):
                here = done[tick + 1] == state
                happens = by_goal[here, : tick + 1].prod(axis=1)[0]
                expected = happens * (exact[here, tick] - value[here, tick])[0]
                assert weighed[here, tick].sum() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize('corrects', [False, True])
def test_replayed_episodes_are_corrected_for_their_own_goals_alone(corrects: bool) -> None:
    class Halves:
        """Each action is half as likely for a goal of 1 as for one of 0; nothing is worth much."""

        def values(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
            return np.zeros(goal.shape[:-1], np.float32)

        def log_probabilities(
            self, observation: np.ndarray, goal: np.ndarray, action: np.ndarray
        ) -> np.ndarray:
            return np.log(np.where(goal[..., 0] > 0.5, 0.25, 0.5)).astype(np.float32)

    states = np.zeros((1, 4, 1), np.float32)
    episodes = Episodes(states, states, np.zeros((1, 1), np.float32), states[:, :3])
    maker = RolloutMaker(
        Halves(), lambda achieved, goal: -np.ones(achieved.shape[:-1]), 1.0, 1.0, corrects
    )
    made = maker.make(episodes, [np.ones((1, 1), np.float32)])
    own, replayed = made.value_target.reshape(2, 3)
    assert own.tolist() == [-3.0, -2.0, -1.0]
    assert replayed.tolist() == ([-1.75, -1.5, -1.0] if corrects else own.tolist())


def reached(achieved: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return -1.0 * (np.abs(achieved - goal)[..., 0] > 0.1)


def one_step(learner: PPO, generator: np.random.Generator) -> Episodes:
    """Episodes of one tick for goals from -.8 to .8; the action is what is achieved."""
    observation = np.zeros((256, 2, 1), np.float32)
    goal = generator.uniform(-0.8, 0.8, (256, 1)).astype(np.float32)
    mean, _ = learner.acting_policy().predict(
        {'observation': observation[:, 0], 'desired_goal': goal}
    )
    action = (mean + 0.3 * generator.standard_normal((256, 1))).clip(-1, 1)
    achieved = np.stack([np.zeros_like(action), action], axis=1)
    return Episodes(observation, achieved, goal, action[:, None].astype(np.float32))


def learn(cycles: int, **changes: object) -> tuple[PPO, RolloutMaker]:
    generator = np.random.default_rng(0)
    config = configured(learning_rate=3e-3, action_l2=0.0, gamma=0.5, **changes)
    learner = make_ppo(config, 1, 1, 1)
    corrects = config.importance == 'decision'
    maker = RolloutMaker(learner, reached, config.gamma, 0.95, corrects)
    for _ in range(cycles):
        episodes = one_step(learner, generator)
        copies = 0 if config.strategy == 'none' else 4
        goals = [goals_in_hindsight(episodes, {'random': 1.0}, generator) for _ in range(copies)]
        rollouts = maker.make(episodes, goals)
        for _ in range(20):
            row = generator.integers(len(rollouts.reward), size=256)
            arrays = {each.name: getattr(rollouts, each.name)[row] for each in fields(rollouts)}
            learner.update(RolloutTransitions(**arrays))
        learner.average()
    return learner, maker


@pytest.mark.parametrize(
    ('cycles', 'changes'),
    [
        (20, {'strategy': 'none'}),
        pytest.param(40, {'importance': 'decision'}, marks=pytest.mark.release),
    ],
    ids=['none', 'weighed'],
)
def test_ppo_learns_to_follow_the_goal(cycles: int, changes: dict[str, object]) -> None:
    learner, _ = learn(cycles, **changes)
    goal = np.linspace(-0.7, 0.7, 15, dtype=np.float32)[:, None]
    actor = learner.evaluation_actor()
    action, _ = actor.predict({'observation': np.zeros_like(goal), 'desired_goal': goal})
    assert np.abs(action - goal).mean() < 0.1


def test_gain_makes_the_first_actions_small_and_leaves_their_direction() -> None:
    actions = []
    for gain in (1.0, 0.01):
        learner = make_ppo(configured(first_action_gain=gain, first_value=-50.0), 1, 1, 4)
        asked = dict.fromkeys(('observation', 'desired_goal'), np.ones((1, 1), np.float32))
        actions.append(learner.evaluation_actor().predict(asked)[0])
        assert learner.values(*asked.values()) == pytest.approx(-50.0, abs=1.0)
    assert np.abs(actions[0]).max() > 0.1
    np.testing.assert_allclose(actions[1], 0.01 * np.arctanh(actions[0]), rtol=1e-3)


def test_outcomes_are_goals_achieved_from_similar_starts() -> None:
    generator = np.random.default_rng(0)
    achieved = np.zeros((3, 11, 3), np.float32)
    achieved[:, :, 0] = np.array([[0.0], [1.0], [2.0]])
    achieved[0, 5:, 0] += 0.5
    achieved[1, :, 0] += np.linspace(0, 0.04, 11, dtype=np.float32)
    nothing = np.zeros((3, 11, 3), np.float32)
    episodes = Episodes(nothing, achieved, nothing[:, 0], nothing[:, 1:])
    metric = GoalMetric(task_spec('FetchPush'))
    outcomes = Outcomes.of(episodes, metric, generator)
    assert 0 < len(outcomes) <= 4, 'what would be met where it began is none'
    assert set(outcomes.before[:, 0]) == {0.0} and set(outcomes.after[:, 0]) == {0.5}
    goal = goals_in_hindsight(episodes, {'outcome': 1.0}, generator, outcomes)
    np.testing.assert_allclose(goal, [[0.5, 0.0, 0.0], [1.5, 0.0, 0.0], [2.5, 0.0, 0.0]])
    none = Outcomes.of(episodes.select(np.array([1, 2])), metric, generator)
    assert len(none) == 0
    goal = goals_in_hindsight(episodes, {'outcome': 1.0}, generator, none)
    np.testing.assert_array_equal(goal, episodes.desired_goal)


def test_outcomes_near_what_was_asked_for_come_first() -> None:
    achieved = np.zeros((2, 2, 3), np.float32)
    achieved[:, 1, 0] = 0.3, -0.3
    asked = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], np.float32)
    nothing = np.zeros((2, 2, 3), np.float32)
    episodes = Episodes(nothing, achieved, asked, nothing[:, 1:])
    generator = np.random.default_rng(0)
    outcomes = Outcomes.of(episodes, GoalMetric(task_spec('FetchPush')), generator)
    starts = Starts(episodes, np.arange(2), np.zeros(2, np.int64))
    drawn = np.concatenate([outcomes.goals(starts, generator)[:, 0] for _ in range(100)])
    # Of eight, one at least is on the side of the goal in 255 of 256.
    assert (drawn * np.tile([1.0, -1.0], 100) > 0).mean() > 0.97


def test_rollouts_hold_every_episode_once_for_each_goal() -> None:
    learner, maker = learn(1, strategy='none')
    action = np.array([[[0.5]], [[-0.5]]], np.float32)
    achieved = np.concatenate([np.zeros_like(action), action], axis=1)
    own = np.array([[0.5], [0.5]], np.float32)
    other = np.array([[0.0], [-0.5]], np.float32)
    episodes = Episodes(np.zeros((2, 2, 1), np.float32), achieved, own, action)
    rollouts = maker.make(episodes, [other])
    assert rollouts.goal[:, 0].tolist() == [0.5, 0.5, 0.0, -0.5]
    assert rollouts.action[:, 0].tolist() == [0.5, -0.5, 0.5, -0.5]
    assert rollouts.reward.tolist() == [0, -1, -1, 0]
    assert rollouts.advantage.mean() == pytest.approx(0, abs=1e-6)
    assert rollouts.advantage.std() == pytest.approx(1, abs=1e-5)
    states = np.zeros((4, 1), np.float32)
    last = learner.values(states, rollouts.goal)
    np.testing.assert_allclose(rollouts.value_target, rollouts.reward + 0.5 * last)
    logs = learner.log_probabilities(states, rollouts.goal, rollouts.action)
    np.testing.assert_allclose(rollouts.log_probability, logs, rtol=1e-5)


@pytest.mark.parametrize('share', [0.0, 0.75, 1.0])
def test_a_share_of_a_batch_is_from_episodes_that_moved_the_object(share: float) -> None:
    config = recipe_config('FetchPush', 'best', **ON_POLICY, moved_share=share, batch_size=4000)
    spec, generator = task_spec('FetchPush'), np.random.default_rng(0)
    cpu = torch.device('cpu')
    learner, experience = make_learner(config, GoalMetric(spec), cpu, Workers(), generator)
    count, ticks = config.num_envs, spec.episode_ticks
    observation = np.zeros((count, ticks + 1, spec.observation_size), np.float32)
    observation[:, :, 0] = np.arange(count)[:, None]
    achieved = np.zeros((count, ticks + 1, 3), np.float32)
    moved = np.array([2, 5])
    achieved[moved, 20:] = 0.1
    goal, action = np.ones((count, 3), np.float32), np.zeros((count, ticks, 4), np.float32)
    experience.normalize(Episodes(observation, achieved, goal, action), learner.actor)
    drawn = experience.batch().observation[:, 0]
    found = np.isin(drawn, moved).mean()
    assert found == pytest.approx(share + (1 - share) * 2 / count, abs=0.03)
    assert set(drawn) >= set(moved)


def batch_of(inputs: np.ndarray, action: np.ndarray, *others: np.ndarray) -> RolloutTransitions:
    """Transitions of inputs (state, goal); their value targets contain the rewards."""
    state, goal, nothing = inputs[:, :1], inputs[:, 1:], np.zeros(len(action))
    arrays = state, state, goal, action, nothing, nothing, *others
    return RolloutTransitions(
        **{
            each.name: array.astype(np.float32)
            for each, array in zip(fields(RolloutTransitions), arrays, strict=True)
        }
    )


def test_the_first_losses_are_those_of_the_definition() -> None:
    """Two actions each, within the range and at its limits; weights, and ratios either way."""
    config = configured(action_l2=0.7, learning_rate=0.0)
    learner = make_ppo(config, 1, 1, 2, hidden=(4,))
    ratio = np.array([0.5, 0.5, 0.9, 1.1, 2.0, 2.0])
    advantage = np.array([1.0, -1.0, 3.0, -2.0, 4.0, -5.0])
    # Ratios are clipped at 1.2 for positive advantages and at 0.8 for negative ones.
    gain = np.array([0.5, -0.8, 2.7, -2.2, 4.8, -10.0])
    weight = np.array([0.1, 2.0, 1.0, 0.5, 1.5, 0.3])
    target = np.linspace(-3.0, 0.0, 6)
    action = np.array([[0.1, -0.4], [1.0, 0.3], [0.2, -1.0], [-1.0, 1.0], [0.8, 0.0], [-0.6, 0.5]])
    inputs = np.random.default_rng(0).normal(size=(6, 2))

    def said(network: torch.nn.Module) -> np.ndarray:
        first, bias, last, offset = (value.detach().numpy() for value in network.parameters())
        return np.maximum(inputs @ first.T + bias, 0.0) @ last.T + offset

    mean, value = np.tanh(said(learner.actor.network)), said(learner.critic)[:, 0]
    inside = np.exp(-np.square((action - mean) / 0.3) / 2) / (0.3 * math.sqrt(2 * math.pi))
    # Of noise beyond a limit, all that lies there counts.
    beyond = np.vectorize(math.erfc)((1.0 - np.sign(action) * mean) / (0.3 * math.sqrt(2))) / 2
    density = np.where(np.abs(action) == 1.0, beyond, inside).prod(axis=1)
    logs = np.log(density / ratio)
    losses = learner.update(batch_of(inputs, action, logs, advantage, target, weight))
    critic_loss = (weight * np.square(value - target)).mean()
    assert losses.critic.item() == pytest.approx(critic_loss, rel=1e-4)
    actor_loss = -(weight * gain).mean() + 0.7 * np.square(mean).mean()
    assert losses.actor.item() == pytest.approx(actor_loss, rel=1e-4)
    assert losses.value.item() == pytest.approx(value.mean(), rel=1e-4)


@pytest.mark.parametrize('advantage', [-1.0, 1.0])
@pytest.mark.parametrize('log_ratio', [-200.0, 95.0, 200.0])
def test_probabilities_that_float32_cannot_compare_ruin_no_network(
    log_ratio: float, advantage: float
) -> None:
    """As of goals in hindsight beside little noise: exp(89) is beyond float32."""
    learner = make_ppo(configured(), 1, 1, 2, hidden=(4,))
    inputs, action, one = np.full((6, 2), 0.3), np.full((6, 2), 0.2, np.float32), np.ones(6)
    state = np.full((6, 1), 0.3, np.float32)
    logs = learner.log_probabilities(state, state, action)
    batch = batch_of(inputs, action, logs - log_ratio, advantage * one, 0.0 * one, one)
    for _ in range(3):
        losses = learner.update(batch)
        assert torch.isfinite(losses.actor)
    for value in learner.actor.state_dict().values():
        assert torch.isfinite(value).all()
