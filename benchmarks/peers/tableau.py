"""Tsitouras' method for the C++ by hand."""

import diffrax


def definitions():
    """Return the coefficients A21 to A76 and the weights E1 to E7 of its error, by name."""
    tableau = diffrax.Tsit5.tableau
    numbers = {f"A{i + 2}{j + 1}": float(x) for i, row in enumerate(tableau.a_lower) for j, x in enumerate(row)}
    return numbers | {f"E{i + 1}": float(x) for i, x in enumerate(tableau.b_error)}
