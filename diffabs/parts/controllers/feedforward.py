"""Feed-forward inputs: the control to which a controller adds its feedback."""

from diffabs.core.protocols import BrakeOutput, Plant
from diffabs.core.pytree import param, pytree
from diffabs.core.types import Scalar


@pytree
class ConstantInput:
    """A constant feed-forward: the input of a controller without a model of mass or road."""

    value: Scalar = param(default=0.0, unit="control")
    """Feed-forward control."""

    def input(self, plant: Plant, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return `value`, in the unit of the plant's control."""
        del plant, output, target
        return self.value


@pytree
class HoldingInput:
    """The control that holds the plant's first output at the setpoint: tau* of Maeda and Sugiura.

    It uses the plant's own parameters, as if the controller knew a swept mass or road exactly. The other conditions,
    such as speed and distance, are the measured ones.
    """

    def input(self, plant: Plant, output: BrakeOutput, target: Scalar) -> Scalar:
        """Return tau* = plant.holding(output, target), in the unit of the plant's control.

        `output` is the measured output. `target` is the reference's final value (`setpoint`), not its present output.
        """
        return plant.holding(output, target)
