"""Prints constraints.txt: everything pip installed in the environment this runs in, pinned.

Run `.venv/bin/python tools/pin_versions.py > constraints.txt` when the dependencies changed and the
tests pass with them.
"""

from __future__ import annotations

from importlib.metadata import distributions

HEADER = """\
# Exactly what was tested: the whole environment of `make env`, written by tools/pin_versions.py.
# Pins matter twice. PyPI holds wheels of several ROS distributions under one name, and an unpinned
# torch pulls the newest CUDA build; `torch==` also matches the CPU build (2.13.0+cpu), which pip
# prefers where an index offers it (see CONTRIBUTING.md).
"""


def pins() -> list[str]:
    """Returns `name==version` of each installed distribution except this project, sorted.

    The ROS wheels carry a second, older set of metadata that pip did not install and cannot
    resolve; those are left out. A local version such as `+cpu` is cut off.
    """
    found = {
        f'{each.name}=={each.version.partition("+")[0]}'
        for each in distributions()
        if each.read_text('INSTALLER') == 'pip\n' and each.name != 'fetch_hand_sim'
    }
    return sorted(found, key=str.lower)


if __name__ == '__main__':
    print(HEADER + '\n'.join(pins()))
