"""What the regulation leaves to the test house: the section [assess] of a scenario."""

from collections.abc import Iterator

from diffabs.core.arrays import as_rule_array
from diffabs.core.pytree import param, pytree, static
from diffabs.core.rules import Rule
from diffabs.core.types import Scalar

OF_ONE_TRACK = ("5.2.1", "5.3.1", "5.3.2", "5.3.3")
OF_A_SPLIT_ROAD = ("5.3.4", "5.3.7")
ADHESION_SOURCES = ("road", "axles")
DRIVEN = ("front", "rear", "both")


@pytree
class StopProgram:
    """Roads, load, speed and limits that the regulation leaves to the test house.

    >>> from diffabs.assess import StopProgram
    >>> StopProgram(low=0.25).high
    0.8
    """

    high: Scalar = param(default=0.8, unit="1", low=0.5, high=1.5)
    """Coefficient of adhesion of the good road, about 0.8."""
    low: Scalar = param(default=0.3, unit="1", low=0.05, high=0.4)
    """Coefficient of adhesion of the slippery road, at most 0.3."""
    load: Scalar = param(default=400.0, unit="kg", low=0.0, high=1e5)
    """Mass that a laden car carries at its centre of gravity."""
    fast: Scalar = param(default=120.0, unit="km/h", low=55.0, high=400.0)
    """The high speed."""
    steering_ratio: Scalar = param(default=16.0, unit="1", low=1.0, high=100.0)
    """Angle of the steering wheel per steer angle."""
    brief: Scalar = param(default=0.1, unit="s", low=0.0, high=10.0)
    """Longest time for which a wheel may lock above 15 km/h; the regulation allows brief locking without a number."""
    adhesion: str = static(default="road")
    """Coefficient k of the utilised adhesion: that of the `road`, or measured with one axle at a time: `axles`."""
    driven: str = static(default="rear")
    """Driven axle, `front`, `rear` or `both`: its rolling resistance counts in a measured k."""

    def problems(self) -> Iterator[str]:
        """Yield a line for an unknown name."""
        for field, names in (("adhesion", ADHESION_SOURCES), ("driven", DRIVEN)):
            if getattr(self, field) not in names:
                yield f'{field} = "{getattr(self, field)}" is unknown; there is {", ".join(names)}'

    def rules(self) -> Iterator[Rule]:
        """Yield the rule that the good road has at least twice the adhesion of the slippery one."""
        yield Rule(
            as_rule_array(self.high) >= 2 * as_rule_array(self.low),
            "high is below 2 low; clause 5.3.2 needs that ratio",
            lambda: f"high = {self.high:g} is below 2 low = {2 * self.low:g}; clause 5.3.2 needs that ratio",
        )
