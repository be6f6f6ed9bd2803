"""Plants of COMPleib, and the norms that others reached with a static gain.

    dx/dt = A x + B1 w + B u,   z = C1 x + D11 w + D12 u,   y = C x + D21 w,   u = K y

`plants.json` has the matrices, rows of numbers. Plants: F. Leibfritz, "COMPleib: COnstrained Matrix-optimization
Problem library" (Technical Report, University of Trier, 2004), release 1.1. Printed norms: X. Guo, D. Keivan, G.
Dullerud, P. Seiler, B. Hu, "Complexity of derivative-free policy optimization for structured H-infinity control"
(NeurIPS 2023), table 1 and its program: HIFOO 3.501 and `hinfstruct`.
"""

import json
import pathlib
from typing import NamedTuple

import numpy as np

FILE = pathlib.Path(__file__).with_name("plants.json")


class Reached(NamedTuple):
    """The best of three random starts of HIFOO 3.501 with HANSO 2.0 in GNU Octave 7.3, with their default options.

    Attributes:
        norm: H-infinity norm.
        evaluations: Evaluations, also those of the search for a stable loop and of gradient sampling.
    """

    norm: float
    evaluations: int


class Printed(NamedTuple):
    """Printed norms.

    Attributes:
        hifoo: Norm of HIFOO.
        hinfstruct: Norm of `hinfstruct`, three digits.
    """

    hifoo: float
    hinfstruct: float


PRINTED = {
    "AC15": Printed(15.2919, 15.2),
    "HE4": Printed(22.8382, 22.8),
    "HF2D11": Printed(7.7237e4, 7.72e4),
}
REACHED = {
    "AC2": Reached(0.1114893, 271),
    "AC3": Reached(3.6774219, 1032),
    "AC4": Reached(0.93546701, 453),
    "AC11": Reached(2.9329715, 8354),
    "AC15": Reached(15.201881, 2446),
    "AC16": Reached(16.558032, 1067),
    "AC17": Reached(6.6124292, 46),
    "HE1": Reached(0.15403842, 187),
    "HE2": Reached(4.1971686, 358),
    "HE4": Reached(22.890925, 17363),
    "REA1": Reached(0.89809323, 198),
    "REA2": Reached(1.1509654, 436),
    "DIS2": Reached(1.0547796, 881),
    "DIS5": Reached(1035.5312, 1733),
    "MFP": Reached(31.58987, 9573),
    "NN2": Reached(2.2215833, 29),
    "NN4": Reached(1.3628348, 2296),
    "NN8": Reached(2.9016112, 404),
    "NN15": Reached(0.10462227, 71),
    "NN17": Reached(11.218214, 483),
    "HF2D11": Reached(77237.296, 16319),
}


class Plant(NamedTuple):
    """A plant with disturbance w, control u, output z and measurement y; the direct path from u to y is zero.

    Attributes:
        A: Matrix (n, n).
        B1: Matrix (n, nw).
        B: Matrix (n, nu).
        C1: Matrix (nz, n).
        C: Matrix (ny, n).
        D11: Matrix (nz, nw).
        D12: Matrix (nz, nu).
        D21: Matrix (ny, nw).
    """

    A: np.ndarray
    B1: np.ndarray
    B: np.ndarray
    C1: np.ndarray
    C: np.ndarray
    D11: np.ndarray
    D12: np.ndarray
    D21: np.ndarray

    def close(self, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the matrices (A, B, C, D) from w to z of the loop with u = K y."""
        entry, exit_ = self.B @ gain, self.D12 @ gain
        return (
            self.A + entry @ self.C,
            self.B1 + entry @ self.D21,
            self.C1 + exit_ @ self.C,
            self.D11 + exit_ @ self.D21,
        )


def load_plants() -> dict[str, Plant]:
    """Return the plants by their names."""
    stored = json.loads(FILE.read_text(encoding="utf-8"))
    return {
        name: Plant(**{key: np.array(rows, float) for key, rows in plant.items()}) for name, plant in stored.items()
    }
