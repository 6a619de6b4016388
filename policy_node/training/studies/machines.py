"""What a run's processor time was measured on."""

from __future__ import annotations

import os
import platform
from pathlib import Path


def machine() -> str:
    """Processor and number of cores."""
    return f'{processor()}, {os.cpu_count()} cores'


def processor() -> str:
    """Model of the processor; where Linux names none, its architecture."""
    info = Path('/proc/cpuinfo')
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(':')[1].strip() for line in lines if line.startswith('model name')]
    return models[0] if models else platform.machine()
