"""A pytest plugin that collects as ROS Jazzy's `launch_testing` does, without optional libraries.

Its hook imports every test module while pytest reads the folder of the module.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from _pytest.pathlib import import_path

MISSING = ('onnx', 'stable_baselines3', 'mcap_ros2', 'matplotlib', 'tensorboard', 'pyarrow')
sys.modules.update(dict.fromkeys(MISSING))


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    import_path(module_path, root=None, consider_namespace_packages=False)
    return pytest.Module.from_parent(parent, path=module_path)
