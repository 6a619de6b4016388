"""Imports go one way: msgs_spec <- node_runtime <- fetch_hand_sim | policy_node; no cycles."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from itertools import chain
from pathlib import Path

import pytest

from support import ROOT

PACKAGES = ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node')
TRAINING = 'policy_node.training'
RESEARCH = f'{TRAINING}.research'

ABOVE_RUNTIME = ('fetch_hand_sim', 'policy_node', 'mujoco', 'gymnasium', 'torch', 'safetensors')
# Packages that modules may not import, even in functions; the innermost key applies.
FORBIDDEN = {
    'msgs_spec': ('node_runtime', *ABOVE_RUNTIME),
    'node_runtime': ABOVE_RUNTIME,
    'fetch_hand_sim': ('policy_node', 'torch', 'safetensors'),
    # Its table names the modules of all commands and imports none of them.
    'fetch_hand_sim.__main__': ('torch', 'safetensors', RESEARCH),
    'policy_node': ('fetch_hand_sim', TRAINING, 'mujoco', 'gymnasium', 'gymnasium_robotics'),
    TRAINING: (RESEARCH,),
    RESEARCH: (),
}
# Part of a forbidden package that every module of the training may import.
REGISTRY = f'{RESEARCH}.registry'
# The shells on the ROS graph; all else runs without ROS.
NODES = (
    'fetch_hand_sim.replay_node',
    'fetch_hand_sim.sim_node',
    'fetch_hand_sim.view.live',
    'fetch_hand_sim.view.live_session',
    'fetch_hand_sim.view.robot_requests',
    'fetch_hand_sim.view.robot_watch',
    'fetch_hand_sim.visualization_node.messages',
    'fetch_hand_sim.visualization_node.node',
    'policy_node.node',
)
ROS = (
    'rclpy',
    'rcl_interfaces',
    'builtin_interfaces',
    'diagnostic_msgs',
    'geometry_msgs',
    'rosgraph_msgs',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'tf2_msgs',
    'visualization_msgs',
)


@dataclass(frozen=True)
class Import:
    """One imported module and where; `nested` if importing the source does not load it."""

    module: str
    line: int
    nested: bool


def is_within(module: str, package: str) -> bool:
    """Return whether `module` is `package` or a part of it."""
    return module == package or module.startswith(package + '.')


def module_name(path: Path) -> str:
    """The dotted name of a source file of this repository."""
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def _absolute(node: ast.ImportFrom, package: str) -> str:
    """The module an `import from` names, relative ones resolved against `package`."""
    if not node.level:
        return node.module or ''
    parents = package.split('.')
    base = parents[: len(parents) - node.level + 1]
    return '.'.join([*base, node.module] if node.module else base)


# Functions whose first argument is the name of a module or package.
_BY_NAME = ('import_module', '__import__', 'find_spec', 'run_module', 'files', 'resolve_name')
# Inside any other text, for `python -m` and the like, a package counts only with what follows it:
# `policy_node` alone is the name of a node and of an executable, which is found as an entry point.
_DOTTED = re.compile(rf'\b(?:{"|".join(PACKAGES)})(?:\.\w+)+')


def _dynamic(node: ast.AST) -> list[str]:
    """The modules named in strings: `import_module('x')`, `find_spec('x')`, `'python -m x.y'`."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return _DOTTED.findall(node.value)
    if not (isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant)):
        return []
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, 'id', '')
    return [str(node.args[0].value)] if name in _BY_NAME else []


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _modules(node: ast.AST, package: str) -> list[str]:
    """The modules a node imports; `from a import b` may mean `a.b`, so it counts as both."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        base = _absolute(node, package)
        return [base, *(f'{base}.{alias.name}' for alias in node.names)]
    return _dynamic(node)


def imports(source: str, package: str) -> Iterator[Import]:
    """Every import in `source`, whose relative imports start from `package`."""

    def visit(node: ast.AST, nested: bool) -> Iterator[Import]:
        for module in _modules(node, package):
            named = isinstance(node, (ast.Import, ast.ImportFrom))
            yield Import(module, getattr(node, 'lineno', 0), nested or not named)
        # Code under `if TYPE_CHECKING` does not run at import, like the body of a function.
        lazy = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)) or (
            isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.unparse(node.test)
        )
        for child in ast.iter_child_nodes(node):
            if not _is_docstring(child):
                yield from visit(child, nested or lazy)

    return visit(ast.parse(source), nested=False)


def is_forbidden(module: str, imported: str) -> bool:
    layer = max((name for name in FORBIDDEN if is_within(module, name)), key=len)
    # `from policy_node.training.research import registry` counts as the package, too.
    allowed = imported == RESEARCH or is_within(imported, REGISTRY)
    if is_within(module, TRAINING) and allowed:
        return False
    return any(is_within(imported, name) for name in FORBIDDEN[layer])


def violations(source: str, module: str, package: str) -> list[str]:
    """The imports of `source` that its layer may not have, as lines to print."""
    return [
        f'{module}:{found.line} imports {found.module}'
        for found in imports(source, package)
        if is_forbidden(module, found.module)
    ]


SOURCES = sorted(path for name in PACKAGES for path in (ROOT / name).rglob('*.py'))


def _package(path: Path) -> str:
    name = module_name(path)
    return name if path.name == '__init__.py' else name.rpartition('.')[0]


def test_modules_import_only_from_allowed_layers():
    found = (violations(path.read_text(), module_name(path), _package(path)) for path in SOURCES)
    assert list(chain.from_iterable(found)) == []


# Circles


def import_graph(modules: Mapping[str, str], late: bool = False) -> dict[str, set[str]]:
    """Which modules each one loads: when it is imported itself, or `late`, in a function, as well.

    Args:
        modules: Source by dotted name; packages end in `.__init__`.
        late: Count imports in functions too, but not those of the package that a module lies in:
            a package may load its parts late, and is there before they are.
    """
    graph = {}
    for name, source in modules.items():
        package = name.rpartition('.')[0]
        found = imports(source, package)
        loaded = {each.module for each in found if late or not each.nested}
        if late:
            loaded.discard(package)
        # `from a import b` counts as `a` and `a.b`; if `a.b` is a module, `a` is only its package.
        places = {module.rpartition('.')[0] for module in loaded if module in modules}
        packages = {f'{module}.__init__' for module in loaded - places}
        graph[name] = ((loaded | packages) & set(modules)) - {name}
    return graph


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Returns one circle of modules that import each other, or nothing."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def _full_name(path: Path) -> str:
    """The dotted name of a source file, `.__init__` included."""
    return '.'.join(path.relative_to(ROOT).with_suffix('').parts)


@cache
def project_graph(late: bool) -> dict[str, set[str]]:
    return import_graph({_full_name(path): path.read_text() for path in SOURCES}, late)


@pytest.mark.parametrize('late', [False, True], ids=['at import', 'in functions'])
def test_no_modules_import_each_other(late):
    assert circle(project_graph(late)) == []


def folders(graph: Mapping[str, set[str]], parent: str) -> dict[str, set[str]]:
    """Which folders in a package load each other, of a graph of modules.

    The package's own modules are none: commands are on top of all folders.
    """

    def folder(module: str) -> str:
        first, *rest = module.removeprefix(f'{parent}.').split('.')
        return first if is_within(module, parent) and rest else ''

    merged: dict[str, set[str]] = {}
    for module, loaded in graph.items():
        if folder(module):
            others = {folder(each) for each in loaded} - {'', folder(module)}
            merged[folder(module)] = merged.get(folder(module), set()) | others
    return merged


@pytest.mark.parametrize('late', [False, True], ids=['at import', 'in functions'])
@pytest.mark.parametrize(
    'parent', ['msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node', TRAINING]
)
def test_no_folders_import_each_other(parent, late):
    assert circle(folders(project_graph(late), parent)) == []


def test_a_circle_of_folders_is_found():
    sources = {'p.a.one': 'from p.b import two', 'p.b.two': '', 'p.b.three': 'import p.a.four'}
    graph = import_graph({**sources, 'p.a.four': '', 'p.command': 'import p.a.one'})
    assert set(circle(folders(graph, 'p'))) == {'a', 'b'}


def test_a_circle_through_a_function_is_found():
    sources = {'p.a': 'from p import b', 'p.b': 'def late():\n    import p.a'}
    assert set(circle(import_graph(sources, late=True))) == {'p.a', 'p.b'}
    shell = {'p.__init__': 'def main():\n    from p.a import run', 'p.a': 'from p import NAME'}
    assert circle(import_graph(shell, late=True)) == []


@pytest.mark.parametrize(
    ('sources', 'expected'),
    [
        ({'p.a': 'from p import b', 'p.b': 'import p.a'}, {'p.a', 'p.b'}),
        ({'p.__init__': 'from p.a import x', 'p.a': 'from p import x'}, {'p.__init__', 'p.a'}),
        ({'p.a': 'from .b import x', 'p.b': 'from .c import x', 'p.c': 'from . import a'}, None),
        ({'p.a': 'from p import b', 'p.b': 'def late():\n    import p.a'}, set()),
        ({'p.__init__': 'from p.a import x', 'p.a': 'from p import b', 'p.b': ''}, set()),
    ],
)
def test_a_circle_is_found(sources, expected):
    wanted = set(sources) if expected is None else expected
    assert set(circle(import_graph(sources))) == wanted


# ROS


def ros_at_import(source: str, package: str) -> list[str]:
    """The ROS modules that importing `source` would load."""
    return [
        each.module
        for each in imports(source, package)
        if not each.nested and any(is_within(each.module, name) for name in ROS)
    ]


def _is_node(path: Path) -> bool:
    return any(is_within(module_name(path), node) for node in NODES)


def test_only_nodes_import_ros():
    others = [path for path in SOURCES if not _is_node(path)]
    found = {module_name(path): ros_at_import(path.read_text(), _package(path)) for path in others}
    assert {name: modules for name, modules in found.items() if modules} == {}


@pytest.mark.parametrize('node', NODES)
def test_ros_in_a_node_is_found(node):
    sources = [path for path in SOURCES if is_within(module_name(path), node)]
    assert any(ros_at_import(path.read_text(), _package(path)) for path in sources)


REWARDS, DEMO = 'fetch_hand_sim.simulation.rewards', 'fetch_hand_sim.commands.demo'


@pytest.mark.parametrize(
    ('module', 'source', 'is_allowed'),
    [
        ('msgs_spec.topics', 'import mujoco', False),
        ('msgs_spec.topics', 'from ..policy_node import actor', False),
        ('msgs_spec.topics', 'def profile():\n    from rclpy.qos import QoSProfile', True),
        (REWARDS, 'def reward():\n    from torch import nn', False),
        (REWARDS, 'if TYPE_CHECKING:\n    import torch', False),
        (REWARDS, "import importlib\nimportlib.import_module('torch')", False),
        (REWARDS, 'import mujoco\nfrom msgs_spec.tasks import TASKS', True),
        (REWARDS, 'import torchless', True),
        ('policy_node.node', 'from .training import replay', False),
        (f'{TRAINING}.train_her', 'from . import replay', True),
        (f'{TRAINING}.train_her', f'from {RESEARCH}.ppo import PPO', False),
        (f'{TRAINING}.train_her', f'from {RESEARCH}.registry import make_learner', True),
        (DEMO, "util.find_spec('policy_node')", False),
        (DEMO, "f'{sys.executable} -m policy_node.node --ros-args'", False),
        (DEMO, "executable('policy_node')", True),
        (DEMO, "entry_points(group='fetch_hand_sim.actors')", True),
        (DEMO, '"""Starts `policy_node.node` by its entry point."""', True),
    ],
)
def test_forbidden_imports_are_found_and_allowed_ones_are_not(module, source, is_allowed):
    assert (violations(source, module, module.rpartition('.')[0]) == []) == is_allowed


def _loaded_by(modules: list[str]) -> set[str]:
    """Top-level names in `sys.modules` of a fresh interpreter after importing `modules`."""
    code = (
        'import importlib, sys\n'
        f'for name in {modules!r}: importlib.import_module(name)\n'
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    result = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


def _modules_of(package: str) -> list[str]:
    """The modules of a package but its `__main__`, whose import starts the program."""
    names = [module_name(path) for path in SOURCES if path.stem != '__main__']
    return [name for name in names if is_within(name, package)]


SIMULATION = {'fetch_hand_sim', 'mujoco', 'gymnasium'}


@pytest.mark.parametrize(
    ('package', 'without', 'expected', 'absent'),
    [
        ('msgs_spec', (), set(), {'node_runtime', 'policy_node', 'torch', 'rclpy', *SIMULATION}),
        # The adapter for Stable-Baselines3 is for those who have it.
        (
            'fetch_hand_sim',
            ('fetch_hand_sim.gym_envs.stable_baselines3',),
            {'msgs_spec', 'mujoco'},
            {'policy_node', 'torch'},
        ),
        ('policy_node', (TRAINING,), {'torch'}, SIMULATION),
    ],
)
def test_importing_a_package_loads_nothing_of_other_layers(package, without, expected, absent):
    modules = [
        name for name in _modules_of(package) if not any(is_within(name, each) for each in without)
    ]
    loaded = _loaded_by(modules)
    assert {package, *expected} <= loaded
    assert loaded.isdisjoint(absent)
