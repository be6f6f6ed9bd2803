"""The input that feedback is added to."""

from typing import Any

from diffabs.core.protocols import BrakeOutput, Plant
from diffabs.core.pytree import Scalar, param, pytree


@pytree
class ConstantInput:
    """A number: what a controller does that knows neither mass nor road."""

    value: Scalar = param(default=0.0, unit="control")

    def input(self, plant: Plant, output: BrakeOutput, target: Scalar) -> Any:
        """The number."""
        del plant, output, target
        return self.value


@pytree
class HoldingInput:
    """The plant's own equilibrium input at the target: tau* of Maeda and Sugiura. It follows a swept mass or road, as a
    controller does that knows them exactly."""

    def input(self, plant: Plant, output: BrakeOutput, target: Scalar) -> Any:
        """tau*, in the unit of the plant's control."""
        return plant.holding(output, target)
