"""The training configuration."""

from __future__ import annotations

from dataclasses import dataclass

from policy_node.training.configuration.config_fields import ConfigFields
from policy_node.training.configuration.config_rules import require_allowed


@dataclass(frozen=True, slots=True)
class TrainConfig(ConfigFields):
    """Everything that decides what a run learns; the same file on every worker.

    Raises:
        ValueError: If a value is not allowed, or fields exclude each other.
    """

    def __post_init__(self) -> None:
        require_allowed(self)
