"""`make bench-her`: when a run counts as there, the table, and a real run of each kind."""

from __future__ import annotations

import csv
from pathlib import Path

import bench_her
import pytest


def evaluations(competitor: str, *points: tuple[float, int, float]) -> list[dict[str, object]]:
    run = {'task': 'FetchPush', 'competitor': competitor, 'seed': 0, 'threads': 1}
    run |= {'limit': 100.0, 'target': 0.95, 'episodes': 100}
    return [run | {'seconds': s, 'env_steps': n, 'success': r} for s, n, r in points]


OURS = evaluations('this_project', (10.0, 1000, 0.5), (20.0, 2000, 0.95))
SLOW = evaluations('sb3_sac', (40.0, 3000, 0.1), (100.1, 6000, 0.94))


def test_the_first_evaluation_with_the_target_counts() -> None:
    back = evaluations('sb3_tqc', (50.0, 700, 0.96), (60.0, 800, 0.2))
    summary = bench_her.summarize([*OURS, *SLOW, *back])
    assert [row['reached'] for row in summary] == [True, False, True]
    assert [row['seconds'] for row in summary] == [20.0, None, 50.0]
    assert [row['env_steps'] for row in summary] == [2000, None, 700]
    assert [row['times_ours'] for row in summary] == [1.0, 5.0, 2.5]
    lines = bench_her.table(summary).splitlines()
    assert '| 20 | 2,000 | 1.0 | 0.95, 2,000 |' in lines[2]
    assert '| > 100 | > 6,000 | > 5.0 | 0.94, 6,000 |' in lines[3]
    failed = evaluations('this_project', (100.0, 5000, 0.4))
    ratios = [row['times_ours'] for row in bench_her.summarize([*failed, *SLOW])]
    assert ratios == [None, None], 'a failed run has no ratio'


def test_ctrl_c_ends_all_tasks_and_keeps_the_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class InterruptedRun:
        def __init__(self, competitor: str, task: str, options: object) -> None:
            started.append(task)
            self.rows = [row | {'task': task} for row in OURS]

        def wait(self) -> None:
            raise KeyboardInterrupt

        def stop(self) -> None:
            pass

    started: list[str] = []
    monkeypatch.setattr(bench_her, 'Run', InterruptedRun)
    arguments = ['--competitors', 'this_project', '--output', str(tmp_path)]
    assert bench_her.main(arguments) == 130
    assert started == ['FetchPush']
    assert 'FetchPush | this project' in (tmp_path / 'bench_her.md').read_text()


@pytest.mark.release
def test_competitors_train_on_the_same_task(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ['--tasks', 'FetchReach', '--competitors', 'this_project', 'sb3_sac']
    arguments += ['--limit', '1', '--episodes', '5', '--evaluate-every', '500', '--threads', '1']
    assert bench_her.main([*arguments, '--side-by-side', '--output', str(tmp_path)]) == 0
    assert 'Stable-Baselines3, SAC + HER | 1 | > 1 |' in capsys.readouterr().out
    with (tmp_path / 'bench_her.csv').open() as file:
        assert file.readline().startswith('# ')
        rows = list(csv.DictReader(file))
    assert [row['competitor'] for row in rows] == ['this_project', 'sb3_sac']
    # A busy machine takes few steps in the second of the limit.
    assert all(int(row['last_env_steps']) > 0 for row in rows)
    assert (tmp_path / 'bench_her.png').read_bytes()[:4] == b'\x89PNG'
