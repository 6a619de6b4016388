"""Runs tests and documented examples of Gymnasium-Robotics 1.4.2 on the ids of this package.

Usage: gymnasium_robotics_suite.py [--source REPOSITORY]

Its tests are not in its wheel: they come from its git repository, which needs the network, or from
a folder with its files. Nothing of it is kept. An example counts if the reference itself runs it,
with `python -O`, without which its Fetch and hand environments fail on MuJoCo 4. Exits with 0 if
all tests pass and all such examples run, with 3 if there is no source.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from importlib.util import find_spec
from pathlib import Path

from fetch_hand_sim.gym_envs.registration import reference_ids

REPOSITORY = 'https://github.com/Farama-Foundation/Gymnasium-Robotics'
VERSION = 'v1.4.2'
# Of its tests, those of the environments that this package has. Left out: touch sensors, and three
# cases of `test_manipulate.py` with `target_position='fixed'`, which none of the tasks has.
TESTS = (
    'tests/test_envs.py',
    'tests/envs/hand/test_reach.py',
)
PAGES = ('README.md', 'docs/content', 'docs/envs/fetch', 'docs/envs/shadow_dexterous_hand')
DOCSTRINGS = ('fetch', 'shadow_dexterous_hand')
# Imports that examples omit, in the reference and here.
THEIRS = 'import gymnasium, gymnasium_robotics\ngymnasium.register_envs(gymnasium_robotics)\n'
OURS = 'import fetch_hand_sim\nfetch_hand_sim.register_gymnasium_robotics(override=True)\n'
# Loaded by pytest before its tests: they take the environments that `tests.utils` lists.
PLUGIN = OURS + textwrap.dedent("""
    import gymnasium
    from fetch_hand_sim.gym_envs.registration import reference_ids
    from tests import utils

    utils.all_testing_env_specs[:] = [gymnasium.spec(name) for name in reference_ids()]
""")


def fetch(source: str, directory: Path) -> None:
    """Copies tests and pages of the version into `directory`."""
    if (Path(source) / 'tests').is_dir():
        shutil.copytree(source, directory, dirs_exist_ok=True)
        return
    clone = ['clone', '--quiet', '--no-checkout', '--depth', '1', '--filter', 'blob:none']
    subprocess.run(['git', *clone, '--branch', VERSION, source, str(directory)], check=True)
    subprocess.run(['git', 'checkout', VERSION, '--', 'tests', *PAGES], cwd=directory, check=True)


def run_tests(directory: Path) -> bool:
    """Runs the tests in a process of their own; whether all passed."""
    (directory / 'ours_plugin.py').write_text(PLUGIN)
    options = ['-q', '-p', 'ours_plugin', '-p', 'no:cacheprovider', '--rootdir', str(directory)]
    # The configuration of the suite's own repository does not hold here.
    command = [sys.executable, '-m', 'pytest', '-c', os.devnull, *options, *TESTS]
    return subprocess.run(command, cwd=directory, env=environment(directory)).returncode == 0


def environment(directory: Path) -> dict[str, str]:
    """Where Python finds the suite; pictures need no display."""
    path = os.pathsep.join([str(directory), os.environ.get('PYTHONPATH', '')])
    return {'MUJOCO_GL': 'egl', **os.environ, 'PYTHONPATH': path}


def examples(directory: Path) -> dict[str, str]:
    """The code blocks of pages and docstrings that make a Fetch or hand environment."""
    files = [path for page in PAGES for path in sorted((directory / page).rglob('*.md'))]
    files += [directory / page for page in PAGES if page.endswith('.md')]
    package = find_spec('gymnasium_robotics')
    assert package is not None and package.origin is not None
    for family in DOCSTRINGS:
        files += sorted((Path(package.origin).parent / 'envs' / family).glob('*.py'))
    found = {}
    for path in files:
        blocks = re.findall(r'```(?:python)?\n(.*?)```', path.read_text(), flags=re.DOTALL)
        for number, block in enumerate(blocks, start=1):
            if re.search(r'make\(\s*[\'"](Fetch|Hand)', block) and 'TouchSensors' not in block:
                folder = '' if path.parent == directory else f'{path.parent.name}/'
                found[f'{folder}{path.name} #{number}'] = up_to_date(textwrap.dedent(block))
    return found


def up_to_date(code: str) -> str:
    """Code with the versions that 1.4.2 registers; its documentation is older."""
    versions = {name.partition('-')[0]: name for name in reference_ids()}
    return re.sub(
        r'\b((?:Fetch|Hand)\w+)-v\d', lambda match: versions.get(match[1], match[0]), code
    )


def error_of(code: str, *flags: str) -> str:
    """Runs code; the last line of its error, or nothing."""
    command = [sys.executable, *flags, '-c', code]
    with tempfile.TemporaryDirectory() as directory:
        result = subprocess.run(command, cwd=directory, capture_output=True, text=True)
    return '' if result.returncode == 0 else result.stderr.strip().rpartition('\n')[2]


def run_examples(directory: Path) -> bool:
    """Runs each example in the reference and here; whether ours runs all that it runs."""
    passed = True
    for name, code in examples(directory).items():
        theirs, ours = error_of(THEIRS + code, '-O'), error_of(OURS + code)
        verdict = 'runs' if not ours else 'FAILS: ' + ours
        if theirs:
            verdict = f'left out, the reference fails: {theirs[:90]} (here: {verdict[:60]})'
        passed = passed and (not ours or bool(theirs))
        print(f'{name}: {verdict}')
    return passed


def main() -> int:
    """Tests, then examples."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        '--source', default=REPOSITORY, help='git repository (default: %(default)s)'
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        directory = Path(temporary)
        try:
            fetch(args.source, directory)
        except (FileNotFoundError, subprocess.CalledProcessError):
            print(f'no {VERSION} of Gymnasium-Robotics at {args.source}', file=sys.stderr)
            return 3
        results = [run_tests(directory), run_examples(directory)]
    return 0 if all(results) else 1


if __name__ == '__main__':
    sys.exit(main())
