"""The pages of the thirteen tasks say what the package and the evaluations of its actors say."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

from msgs_spec.tasks import TASKS
from support import ROOT

TOOL = runpy.run_path(str(ROOT / 'tools' / 'task_pages.py'))
END, START = TOOL['END'], TOOL['START']


@pytest.mark.parametrize('path', TOOL['sections'](), ids=lambda path: path.stem)
def test_a_page_is_up_to_date(path: Path) -> None:
    page = path.read_text(encoding='utf-8')
    renewed = TOOL['with_section'](page, TOOL['sections']()[path])
    assert renewed == page, 'run: make tables, or python tools/task_pages.py --write'
    assert (path.parent / f'../images/tasks/{path.stem}.jpg').is_file() or path.stem == 'index'


def test_a_newly_shipped_actor_is_all_it_takes(tmp_path: Path) -> None:
    task = TASKS['HandManipulatePenRotate']
    assert 'No policy is shipped yet' in TOOL['task_section'](task, tmp_path)
    report = json.loads((TOOL['ACTORS'] / 'HandManipulateEggRotate.json').read_text())
    report |= {'success_gymnasium': 0.25, 'touched': 0.5, 'episodes': 1000, 'dropped': 0.125}
    (tmp_path / f'{task.name}.json').write_text(json.dumps(report))
    section = TOOL['task_section'](task, tmp_path)
    assert '| success at the last step | **0.250** (' in section
    assert '750 of 1,000 episodes: 500 never reached the goal, 250 reached it but lost' in section
    assert '12.5% of the objects lay below the palm' in section
    assert '| 0.250 |' in TOOL['index_section'](tmp_path)
