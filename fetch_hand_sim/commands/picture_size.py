"""The size of pictures on a command line."""

from __future__ import annotations

import argparse


def picture_size(text: str) -> tuple[int, int]:
    """Parses `640x480` into width and height.

    Raises:
        argparse.ArgumentTypeError: If it is not two numbers.
    """
    try:
        width, height = (int(side) for side in text.split('x'))
    except ValueError:
        message = f'{text[:80]!r} given; allowed: two numbers with an x between them'
        raise argparse.ArgumentTypeError(message) from None
    return width, height
