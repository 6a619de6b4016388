"""Running statistics against numpy."""

from __future__ import annotations

import numpy as np

from policy_node.policies.actor import Normalizer
from policy_node.training.experience.experience import RunningStatistics
from policy_node.training.machine import Workers


def test_statistics_over_parts_are_those_of_everything():
    generator = np.random.default_rng(0)
    values = generator.normal([3.0, -2.0], [0.5, 4.0], size=(40, 25, 2))
    statistics, normalizer = RunningStatistics(2), Normalizer(2)
    for part in np.array_split(values, 7):
        statistics.update(part, Workers())
    statistics.write(normalizer)
    flat = values.reshape(-1, 2)
    np.testing.assert_allclose(normalizer.mean, flat.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(normalizer.std, flat.std(axis=0), rtol=1e-5)


def test_std_has_a_floor_and_values_a_ceiling():
    statistics, normalizer = RunningStatistics(2), Normalizer(2)
    statistics.update([[7.0, 1e6], [7.0, 1e6]], Workers())
    statistics.write(normalizer)
    assert normalizer.mean.tolist() == [7.0, 200.0]
    np.testing.assert_allclose(normalizer.std, 0.01)


def test_an_empty_batch_changes_no_statistics():
    statistics, normalizer = RunningStatistics(3), Normalizer(3)
    statistics.update(np.zeros((0, 3)), Workers())
    statistics.write(normalizer)
    assert normalizer.std.tolist() == [1.0, 1.0, 1.0]
