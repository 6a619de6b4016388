"""Two numbers with an x between them on a command line: the size of pictures, of a grid."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from msgs_spec.parameters import LARGEST_PICTURE_SIDE


def two_numbers(largest: int) -> Callable[[str], tuple[int, int]]:
    """Returns what reads `640x480`, each from 1 to `largest`, for `add_argument(type=...)`."""

    def read(text: str) -> tuple[int, int]:
        try:
            first, second = (int(number) for number in text.split('x'))
        except ValueError:
            first = second = 0
        if not (1 <= first <= largest and 1 <= second <= largest):
            raise argparse.ArgumentTypeError(
                f'{text[:80]!r} given; allowed: 1x1 ... {largest}x{largest}'
            )
        return first, second

    return read


picture_size = two_numbers(LARGEST_PICTURE_SIDE)
