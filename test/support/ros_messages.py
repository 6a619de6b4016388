"""Messages of rclpy as those that are serialised without ROS."""

from __future__ import annotations

from array import array
from dataclasses import fields
from typing import Any

import numpy as np

from msgs_spec.schemas import message_class


def from_ros(message: Any) -> Any:
    """Returns a message of rclpy as an instance of `message_class`, to be given to `serialize`."""
    package = type(message).__module__.split('.')[0]
    target = message_class(f'{package}/msg/{type(message).__name__}')
    names = [item.name for item in fields(target) if item.name != '__msgtype__']
    return target(**{name: _plain(getattr(message, name)) for name in names})


def _plain(value: Any) -> Any:
    if hasattr(value, 'get_fields_and_field_types'):
        return from_ros(value)
    if isinstance(value, array | np.ndarray):
        return np.asarray(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    # ROS's `byte` is a bytes object in rclpy and a number in the type store.
    return value[0] if isinstance(value, bytes) else value
