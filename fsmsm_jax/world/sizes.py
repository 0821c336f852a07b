"""Few sizes, so that few programs are compiled.

A program is compiled for the sizes of the arrays it meets, which takes seconds. Where
sizes come from outside, a map's sides, a scan's rays, each new one would be a program
of its own. Rounded up to a **bucket** they share programs: eight buckets lie between a
power of two and the next, so a side grows by an eighth at most, 6 % on average, and
maps from 64 to 16 384 cells wide know 64 widths.
"""

__all__ = ["bucket"]

_STEPS = 8  # buckets from a power of two to the next; and no step is shorter than this


def bucket(size: int) -> int:
    """The bucket that so many fit in: at most an eighth more, or 7.

    Example:
        >>> [bucket(n) for n in (1, 180, 181, 360, 361, 682, 720, 1081)]
        [8, 192, 192, 384, 384, 704, 768, 1152]
    """
    below = 1 << max(size - 1, 1).bit_length() - 1
    step = max(below // _STEPS, _STEPS)
    return -(-size // step) * step
