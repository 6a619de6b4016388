"""Knowledge flows one way: msgs_spec <- fetch_hand_sim, msgs_spec <- policy_node."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from support import ROOT

PACKAGES = ('msgs_spec', 'fetch_hand_sim', 'policy_node')
TRAINING = 'policy_node.training'

# What a module may never import, at any depth of its code, by the innermost package named here.
FORBIDDEN = {
    'msgs_spec': ('fetch_hand_sim', 'policy_node', 'mujoco', 'gymnasium', 'torch', 'safetensors'),
    'fetch_hand_sim': ('policy_node', 'torch', 'safetensors'),
    'policy_node': ('fetch_hand_sim', TRAINING, 'mujoco', 'gymnasium', 'gymnasium_robotics'),
    TRAINING: (),
}
# The shells on the ROS graph; all else runs without ROS.
NODES = (
    'fetch_hand_sim.commands.demo',
    'fetch_hand_sim.replay_node',
    'fetch_hand_sim.sim_node',
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
)


@dataclass(frozen=True)
class Import:
    """One imported module and where."""

    module: str
    line: int
    nested: bool


def is_within(module: str, package: str) -> bool:
    """Whether `module` is `package` or lies in it."""
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


def _dynamic(node: ast.AST) -> list[str]:
    """The module named by `importlib.import_module('x')` or `__import__('x')`."""
    if not (isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant)):
        return []
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, 'id', '')
    return [str(node.args[0].value)] if name in ('import_module', '__import__') else []


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
            yield Import(module, getattr(node, 'lineno', 0), nested)
        # Code under `if TYPE_CHECKING` does not run at import, like the body of a function.
        lazy = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)) or (
            isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.unparse(node.test)
        )
        for child in ast.iter_child_nodes(node):
            yield from visit(child, nested or lazy)

    return visit(ast.parse(source), nested=False)


def forbidden(module: str) -> tuple[str, ...]:
    """What `module` may not import."""
    layer = max((name for name in FORBIDDEN if is_within(module, name)), key=len)
    return FORBIDDEN[layer]


def violations(source: str, module: str, package: str) -> list[str]:
    """The imports of `source` that its layer may not have, as lines to print."""
    return [
        f'{module}:{found.line} imports {found.module}'
        for found in imports(source, package)
        if any(is_within(found.module, name) for name in forbidden(module))
    ]


SOURCES = sorted(path for name in PACKAGES for path in (ROOT / name).rglob('*.py'))


def _package(path: Path) -> str:
    name = module_name(path)
    return name if path.name == '__init__.py' else name.rpartition('.')[0]


@pytest.mark.parametrize('package', PACKAGES)
def test_there_are_modules_to_check(package):
    assert sum(is_within(module_name(path), package) for path in SOURCES) >= 5


@pytest.mark.parametrize('path', SOURCES, ids=module_name)
def test_module_imports_only_what_its_layer_may(path):
    assert violations(path.read_text(), module_name(path), _package(path)) == []


def ros_at_import(source: str, package: str) -> list[str]:
    """The ROS modules that importing `source` would load."""
    return [
        each.module
        for each in imports(source, package)
        if not each.nested and any(is_within(each.module, name) for name in ROS)
    ]


def _is_node(path: Path) -> bool:
    return any(is_within(module_name(path), node) for node in NODES)


@pytest.mark.parametrize('path', [path for path in SOURCES if not _is_node(path)], ids=module_name)
def test_everything_but_the_nodes_imports_without_ros(path):
    assert ros_at_import(path.read_text(), _package(path)) == []


@pytest.mark.parametrize('node', NODES)
def test_ros_in_a_node_is_found(node):
    sources = [path for path in SOURCES if is_within(module_name(path), node)]
    assert any(ros_at_import(path.read_text(), _package(path)) for path in sources)


@pytest.mark.parametrize(
    ('module', 'source'),
    [
        ('msgs_spec.topics', 'import mujoco'),
        ('msgs_spec.topics', 'from fetch_hand_sim import rewards'),
        ('msgs_spec.topics', 'from ..policy_node import actor'),
        ('fetch_hand_sim.simulation.rewards', 'import torch.nn.functional as F'),
        ('fetch_hand_sim.simulation.rewards', 'def reward():\n    from torch import nn'),
        ('fetch_hand_sim.simulation.rewards', 'if TYPE_CHECKING:\n    import torch'),
        ('fetch_hand_sim.simulation.rewards', "import importlib\nimportlib.import_module('torch')"),
        ('fetch_hand_sim.simulation.rewards', "torch = __import__('torch')"),
        ('policy_node.node', 'from fetch_hand_sim.simulation import Simulation'),
        ('policy_node.node', 'from policy_node import training'),
        ('policy_node.node', 'from .training import replay'),
    ],
)
def test_a_forbidden_import_is_found(module, source):
    assert violations(source, module, module.rpartition('.')[0])


@pytest.mark.parametrize(
    ('module', 'source'),
    [
        ('msgs_spec.qos', 'def profile():\n    from rclpy.qos import QoSProfile'),
        ('fetch_hand_sim.simulation.rewards', 'import mujoco\nfrom msgs_spec.tasks import TASKS'),
        ('fetch_hand_sim.simulation.rewards', 'import torchless'),
        (
            'policy_node.training.train_her',
            'from fetch_hand_sim.simulation import Simulation',
        ),
        ('policy_node.training.train_her', 'from . import replay'),
    ],
)
def test_an_allowed_import_is_not(module, source):
    assert violations(source, module, module.rpartition('.')[0]) == []


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


def test_importing_the_contract_loads_no_simulator_network_or_ros():
    loaded = _loaded_by(_modules_of('msgs_spec'))
    assert 'msgs_spec' in loaded
    assert loaded.isdisjoint(
        {'fetch_hand_sim', 'policy_node', 'mujoco', 'gymnasium', 'torch', 'rclpy'}
    )


def test_importing_the_robots_loads_no_torch():
    loaded = _loaded_by(_modules_of('fetch_hand_sim'))
    assert {'fetch_hand_sim', 'msgs_spec', 'mujoco'} <= loaded
    assert loaded.isdisjoint({'policy_node', 'torch'})


def test_importing_the_actor_loads_no_simulation():
    outside_training = [
        name for name in _modules_of('policy_node') if not is_within(name, TRAINING)
    ]
    loaded = _loaded_by(outside_training)
    assert {'policy_node', 'torch'} <= loaded
    assert loaded.isdisjoint({'fetch_hand_sim', 'mujoco', 'gymnasium'})
