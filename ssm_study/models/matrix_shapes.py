"""Shapes of the matrices of a recurrence with neurons, keyed by matrix name."""


def matrix_shapes(n: int, m: int, p: int, q: int) -> dict[str, tuple[int, ...]]:
    """Shape of each matrix of a recurrence with neurons, keyed by the matrix name."""
    linear = {"a": (n, n), "b": (n, m), "c": (p, n), "d": (p, m)}
    return linear | {"e": (n, q), "f": (q, n), "g": (q, m), "h": (p, q), "bias": (q,)}
