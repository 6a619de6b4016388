"""The installed programs, and the modules that `python -m` can start."""

from __future__ import annotations

from importlib.metadata import distribution

from support import ROOT


def console_scripts() -> dict[str, tuple[str, str]]:
    """Module and function of each installed program, by name."""
    points = distribution('fetch_hand_sim').entry_points.select(group='console_scripts')
    return {point.name: (point.module, point.attr) for point in points}


def started_as_modules() -> list[str]:
    """Return the modules that `python -m` can start."""
    found = []
    for package in ('fetch_hand_sim', 'policy_node'):
        for path in sorted((ROOT / package).rglob('*.py')):
            parts = path.relative_to(ROOT).with_suffix('').parts
            if parts == ('policy_node', 'policies', 'onnx'):
                continue  # Only `load_policy` starts it.
            if path.name == '__main__.py':
                found.append('.'.join(parts[:-1]))
            elif "__name__ == '__main__'" in path.read_text():
                found.append('.'.join(parts))
    return found
