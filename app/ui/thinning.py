"""Keeping the page fluid: fewer points of what is sent again with every frame."""


def strided(count: int, most: int) -> slice:
    """Every k-th of `count` points with the smallest k that leaves at most `most`."""
    return slice(0, count, max(1, -(-count // most)))
