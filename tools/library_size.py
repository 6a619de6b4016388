"""Lines of code of the library beside those of an older revision, ability by ability.

    python tools/library_size.py [REVISION]

Counted are lines that hold code: no docstrings, comments or blank lines; both sides are formatted
by ruff. Each row is an ability, wherever its files lay then and lie now; those without a number on
the left are new. The default revision is the last one before the folders got their shape.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REVISION = '2ce2393'
# No library code: it lies in tools/ now.
LEFT_OUT = 'msgs_spec/interface_table.py'
PACKAGES = ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node')

# The first pattern that a path matches names its ability: new ones first, then old names and new.
ABILITIES = {
    'a page in the browser': r'fetch_hand_sim/view/',
    'films and pictures': r'fetch_hand_sim/films/|.*/(render_episode|scene|opengl|pictures)\.py',
    'RViz and other standard tools': r'.*/visualization_node/|.*/urdf\w*\.py|.*/view_topics\.py',
    'drop-in for Gymnasium-Robotics, VecEnv': (
        r'.*/gym_envs/(gymnasium_robotics_env|goal_env|shared_physics|stable_baselines3'
        r'|task_attributes)\.py'
    ),
    'one command for all': r'.*/commands/(main|executables|node_processes)\.py',
    'tasks of other packages': r'.*/foreign_tasks\.py',
    'pushes': r'.*/perturbations\.py',
    'inputs that know geometry, prioritised replay': (
        r'.*/(goal_features|episode_weights|initial_networks|mean_networks|read_networks|replay_file)\.py'
    ),
    'more ways to learn, and studies of them': (
        r'.*/benchmark/(final|measures|research\w*)\.py|.*/learning/(conditions|critics|density_ratio'
        r'|devices|gamble|goal_choice|hierarchy|hindsight_actions|imagined|multi_step|sampling|subgoals)\.py'
    ),
    'studies in parallel, tables of actors': r'.*/(studies|workers|actors_table)\.py',
    'contract and wire': r'msgs_spec/|node_runtime/',
    'file format': r'.*/episode_log/',
    'episodes, their record, check and export': (
        r'.*/episodes/|.*/(episode_(check|export|generator|recorder|runner)|recording_context)\.py'
    ),
    'robot node': r'.*/sim_node/|.*/(command_buffer|pacing)\.py',
    'replay node': r'.*/replay_(node|schedule)',
    'episode commands and demo': (
        r'.*/commands/|.*/((check|list|export|recover)_episodes?|demo)\.py'
    ),
    'environments': r'.*/gym_envs/|.*/(gymnasium_env|vector_env|spaces|registration)\.py',
    'simulation': r'fetch_hand_sim/',
    'policy node': r'policy_node/(node/|stamp_join)',
    'training': r'policy_node/training/',
    'policies': r'policy_node/',
}


def lines_of_code(source: str) -> int:
    """Lines that hold code."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docstrings |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    nothing = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    found: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in (*nothing, tokenize.ENDMARKER):
            found |= set(range(token.start[0], token.end[0] + 1))
    return len(found - docstrings)


def ability(path: str) -> str:
    """The ability that a file belongs to."""
    return next(name for name, pattern in ABILITIES.items() if re.match(pattern, path))


def count_revision(revision: str) -> Counter[str]:
    """Lines by ability at a revision of this repository."""

    def git(*words: str) -> str:
        return subprocess.run(
            ('git', '-C', ROOT, *words), capture_output=True, text=True, check=True
        ).stdout

    found: Counter[str] = Counter()
    for path in git('ls-tree', '-r', '--name-only', revision, *PACKAGES).splitlines():
        if path.endswith('.py') and path != LEFT_OUT:
            found[ability(path)] += lines_of_code(git('show', f'{revision}:{path}'))
    return found


def count_tree() -> Counter[str]:
    """Lines by ability in the working tree."""
    found: Counter[str] = Counter()
    for package in PACKAGES:
        for path in (ROOT / package).rglob('*.py'):
            found[ability(str(path.relative_to(ROOT)))] += lines_of_code(path.read_text())
    return found


def table(before: Counter[str], now: Counter[str], revision: str) -> str:
    """Both side by side as Markdown, with the sum of what there was at the revision."""
    rows = [f'| ability | {revision} | now |', '|---|---|---|']
    rows += [f'| {name} | {before[name] or ""} | {now[name]} |' for name in ABILITIES]
    there = [name for name in ABILITIES if before[name]]
    old, new = before.total(), sum(now[name] for name in there)
    rows.append(f'| what there was at {revision} | {old} | {new} ({new / old - 1:+.1%}) |')
    rows.append(f'| all | {old} | {now.total()} |')
    return '\n'.join(rows)


if __name__ == '__main__':
    chosen = sys.argv[1] if len(sys.argv) > 1 else REVISION
    print(table(count_revision(chosen), count_tree(), chosen))
