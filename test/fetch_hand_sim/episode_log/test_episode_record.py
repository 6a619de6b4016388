"""The records of an episode, parsed: round trips, and invalid text."""

from __future__ import annotations

import pytest

from fetch_hand_sim.episode_log import EpisodeOutcome, EpisodeRecord, episode_metadata
from msgs_spec.tasks import TASKS
from msgs_spec.topics import INTERFACE_VERSION


def metadata(hz: float = 500 / 3, **changes: str) -> dict[str, str]:
    """The record of an episode of FetchPush, with changes."""
    values = episode_metadata(
        TASKS['FetchPush'],
        episode=3,
        seed=2**63 - 1,
        reward_type='dense',
        success_rule='paper',
        control_hz=hz,
        model_sha256='0',
    )
    return {**values, **changes}


def test_what_is_written_is_read_back():
    record = EpisodeRecord.parse(metadata())
    assert (record.task, record.episode, record.seed) == (TASKS['FetchPush'], 3, 2**63 - 1)
    assert (record.reward_type, record.success_rule) == ('dense', 'paper')
    assert (record.control_hz, record.joint_prefix) == (500 / 3, 'robot0:')
    assert record.interface_version == INTERFACE_VERSION
    assert record.timing == 'seconds'


def test_a_record_without_timing_kept_ticks():
    old = metadata()
    del old['timing']
    assert EpisodeRecord.parse(old).timing == 'ticks'
    assert 'timing' not in metadata(hz=25.0), 'files at 25 Hz are as they were'


@pytest.mark.parametrize(
    'outcome',
    [
        EpisodeOutcome(steps=50, episode_return=-0.1 - 0.2, is_success=True),
        EpisodeOutcome(is_complete=False, reason='SIGTERM', steps=0, episode_return=0.0),
        EpisodeOutcome(is_complete=False, reason='x', received_not_logged={'commands': 3}),
        EpisodeOutcome(steps=50, late_commands=0),
    ],
)
def test_outcomes_survive(outcome):
    assert EpisodeOutcome.parse(outcome.to_strings()) == outcome


NUMBERS = ('inf', '-inf', 'nan', '', '-1', str(2**63), '1e999', '9' * 5000, '1.5', 'x', '\x1b[31m')


@pytest.mark.parametrize('text', NUMBERS)
@pytest.mark.parametrize('name', ['seed', 'episode', 'interface_version'])
def test_invalid_numbers_in_the_metadata_are_refused(name, text):
    with pytest.raises(ValueError, match=rf'^{name} ') as caught:
        EpisodeRecord.parse(metadata(**{name: text}))
    assert len(str(caught.value)) < 200 and str(caught.value).isprintable()


@pytest.mark.parametrize('text', ['0', '-1', 'nan', 'inf', '1e-300', '7', '', 'x' * 5000])
def test_invalid_rates_in_the_metadata_are_refused(text):
    with pytest.raises(ValueError, match=r'^control_hz '):
        EpisodeRecord.parse(metadata(control_hz=text))


def test_unknown_words_in_the_metadata_are_refused():
    for name, text in (
        ('reward_type', 'Dense'),
        ('success_rule', ''),
        ('task', '[]'),
        ('timing', 'minutes'),
    ):
        with pytest.raises(ValueError, match='allowed'):
            EpisodeRecord.parse(metadata(**{name: text}))
    with pytest.raises(ValueError, match='joint_prefix of 1000 characters'):
        EpisodeRecord.parse(metadata(joint_prefix='x' * 1000))


@pytest.mark.parametrize('name', ['task', 'episode', 'seed', 'reward_type', 'control_hz'])
def test_what_is_missing_is_named(name):
    without = metadata()
    del without[name]
    with pytest.raises(ValueError, match=f'^{name} is missing'):
        EpisodeRecord.parse(without)


@pytest.mark.parametrize('text', [*NUMBERS, 'True', '[' * 100_000, '{"a": "b"}', 'null'])
def test_an_unreadable_outcome_is_none(text):
    names = ('steps', 'return', 'success', 'complete', 'received_not_logged')
    outcome = EpisodeOutcome.parse(dict.fromkeys(names, text))
    assert outcome.is_success is None and not outcome.is_complete
    assert outcome.steps in (None, -1) and not outcome.received_not_logged
