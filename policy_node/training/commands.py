"""The commands that learn and measure, as executables: light until what they need is found."""

from __future__ import annotations

from node_runtime.command_line import start_command


def train_her() -> int:
    """Runs `train_her`; returns the exit code."""
    return start_command('train_her', 'policy_node.training.train_her', 'train')


def evaluate_policy() -> int:
    """Runs `evaluate_policy`; returns the exit code."""
    return start_command('evaluate_policy', 'policy_node.training.evaluate_policy')


def generate_episodes() -> int:
    """Runs `generate_episodes`; returns the exit code."""
    return start_command('generate_episodes', 'policy_node.training.generate_episodes')


def benchmark() -> int:
    """Runs `benchmark`; returns the exit code."""
    return start_command('benchmark', 'policy_node.training.studies.command', 'train')


def export_actor() -> int:
    """Runs `export_actor`; returns the exit code."""
    return start_command('export_actor', 'policy_node.policies.export_actor', 'actors', 'onnx')
