"""Feed-forward inputs: the control to which a controller adds its feedback."""

from diffabs.core.protocols import BrakeOutput, Plant
from diffabs.core.pytree import Scalar, param, pytree


@pytree
class ConstantInput:
    """A constant feed-forward: the input of a controller without a model of mass or road."""

    value: Scalar = param(default=0.0, unit="control")

    def input(self, plant: Plant, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return the constant, in the unit of the plant's control."""
        del plant, output, target
        return self.value


@pytree
class HoldingInput:
    """The plant's own equilibrium input at the target: tau* of Maeda and Sugiura. It follows a swept mass or road, as
    for a controller with exact parameters.
    """

    def input(self, plant: Plant, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return tau*, in the unit of the plant's control."""
        return plant.holding(output, target)
