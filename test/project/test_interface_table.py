"""The tables of docs/interface.md equal the definitions in the package."""

from __future__ import annotations

import re
import runpy

from msgs_spec.parameters import NODES
from msgs_spec.robots import SHADOW_HAND
from msgs_spec.tasks import TASKS
from msgs_spec.topics import SERVICES, topics, view_topics
from support import ROOT

PAGE = ROOT / 'docs' / 'interface.md'
TOOL = runpy.run_path(str(ROOT / 'tools' / 'interface_table.py'))
END, START = TOOL['END'], TOOL['START']
interface_markdown, main, replace_section = (
    TOOL[name] for name in ('interface_markdown', 'main', 'replace_section')
)


def test_the_page_holds_the_generated_section():
    text = PAGE.read_text(encoding='utf-8')
    assert replace_section(text) == text, (
        'run: python tools/interface_table.py --write docs/interface.md'
    )


def test_everything_has_its_row():
    lines = interface_markdown().splitlines()
    for task in TASKS.values():
        for spec in (*topics(task), *view_topics(task)):
            type_name = spec.type_name.replace('/msg/', '/')
            assert any(line.startswith(f'| `{spec.name}` | {type_name} |') for line in lines)
    for node, specs in NODES.items():
        for spec in specs:
            assert any(
                line.startswith(f'| {node} | `{spec.name}` | {spec.type} |') for line in lines
            )
    for spec in SERVICES:
        assert any(line.startswith(f'| `{spec.name}` |') for line in lines)


def test_the_joints_of_the_hand_have_both_numberings():
    page = (ROOT / 'docs' / 'hand_joints.md').read_text()
    commanded = [part.name for part in SHADOW_HAND.command]
    for index, joint in enumerate(SHADOW_HAND.joints):
        name = joint.removeprefix('robot0:')
        row = re.search(rf'^\| `{name}` \| `rh_(\w+)(\d)` \|.*$', page, re.MULTILINE)
        assert (row[1], int(row[2])) == (name[:-1], int(name[-1]) + 1)
        command = str(commanded.index(joint)) if joint in commanded else 'none, coupled'
        assert row[0].endswith(f'| {index} | {command} |')
