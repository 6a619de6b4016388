"""The log of a run: CSV, TensorBoard and curve."""

from __future__ import annotations

import shutil

import pytest

from policy_node.training.runs.run_log import COLUMNS, RunLog, draw_curve, read_progress


def row(steps, success):
    values = dict.fromkeys(COLUMNS, 1.0)
    return {**values, 'env_steps': steps, 'eval_success': success, 'train_success': 0.25}


def test_a_resumed_run_goes_on_after_its_checkpoint(tmp_path):
    for resumed_steps, steps in ((0, (100, 200, 300)), (200, (250,))):
        log = RunLog(tmp_path, 1000, 0, resumed_steps)
        for step in steps:
            log.write(row(step, None if step == 100 else step / 1000))
        log.close()
    rows = read_progress(tmp_path / 'progress.csv')
    assert [values['env_steps'] for values in rows] == [100, 200, 250]
    assert 'eval_success' not in rows[0] and rows[2]['eval_success'] == 0.25
    assert set(rows[1]) == set(COLUMNS)


@pytest.mark.parametrize('cut', ['1,200,1', '1,200,1,,0.5,-', '1,inf,1,,0.5', '1,200,1,,nan'])
def test_a_line_that_a_killed_run_cut_short_is_dropped(tmp_path, cut):
    log = RunLog(tmp_path, 1000, 0)
    log.write(row(100, 0.5))
    log.close()
    with (tmp_path / 'progress.csv').open('a') as file:
        file.write(cut)
    assert [values['env_steps'] for values in read_progress(tmp_path / 'progress.csv')] == [100]
    RunLog(tmp_path, 1000, 0, resumed_steps=200).close()
    assert [values['env_steps'] for values in read_progress(tmp_path / 'progress.csv')] == [100]


def test_the_live_line_shows_the_progress(tmp_path, capsys):
    log = RunLog(tmp_path, total_steps=7_300_000, time_limit=0)
    log.write({**row(100_000, 0.5), 'steps_per_second': 2000.0, 'seconds': 61.0})
    log.close()
    line = capsys.readouterr().err
    for part in ('100,000 steps', '2,000 steps/s', 'train 0.25', 'eval 0.500', '0:01:01'):
        assert part in line
    assert 'ETA 1:00:00' in line


def test_tensorboard_holds_the_scalars(tmp_path):
    pytest.importorskip('tensorboard')
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = RunLog(tmp_path, total_steps=1000, time_limit=0)
    log.write(row(100, 0.5))
    log.write(row(200, None))
    log.close()
    events = EventAccumulator(str(tmp_path / 'tensorboard'))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars('eval_success')] == [(100, 0.5)]
    assert [e.step for e in events.Scalars('train_success')] == [100, 200]


def test_a_removed_folder_prints_no_traceback(tmp_path, capfd):
    (tmp_path / 'run').mkdir()
    log = RunLog(tmp_path / 'run', total_steps=1000, time_limit=0, quiet=True)
    shutil.rmtree(tmp_path / 'run')
    for step in range(100, 400, 100):
        log.write(row(step, 0.5))
    log.close()
    assert capfd.readouterr().err == ''


def test_the_curve_is_a_png_that_shows_the_numbers(tmp_path):
    low = [{'env_steps': 100.0 * i, 'train_success': 0.1, 'eval_success': 0.1} for i in range(5)]
    high = [{**row, 'eval_success': 0.9} for row in low]
    pictures = []
    for rows in (low, high):
        draw_curve(rows, 'FetchReach', tmp_path / 'curve.png')
        pictures.append((tmp_path / 'curve.png').read_bytes())
    assert pictures[0][:8] == b'\x89PNG\r\n\x1a\n'
    assert pictures[0] != pictures[1]
