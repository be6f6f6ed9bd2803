"""Fields of diffrax: the right-hand side of a term for `diffabs.solve`."""

from collections.abc import Callable

from diffabs.core.types import PyTree, Scalar


def field_of(term: object) -> Callable[[Scalar, PyTree, PyTree], PyTree]:
    """Return the vector field of a `diffrax.ODETerm`, for `diffabs.solve`.

    Args:
        term: The term. One that is driven by noise or a control has no field.

    Raises:
        ValueError: The value is no `ODETerm`.

    Examples:
        >>> import diffabs as d
        >>> import diffrax  # doctest: +SKIP
        >>> term = diffrax.ODETerm(lambda t, y, args: -y)  # doctest: +SKIP
        >>> d.solve(field_of(term), 1.0, 0.0, 1.0, solver=d.Adaptive(1e-6)).y  # doctest: +SKIP
        Array(0.36787945, dtype=float32)
    """
    import diffrax  # an optional package, needed by those who have a term of it

    if not isinstance(term, diffrax.ODETerm):
        raise ValueError(f"term = {term!r} is no diffrax.ODETerm; a term with a control or noise has no field")
    return term.vector_field
