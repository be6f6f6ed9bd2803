"""Friction curves, `friction(slip, speed, distance) -> mu`, and tyres, `braking_force(slip, load, speed, distance)`."""

from diffabs.parts.roads.along import ScaledAlong as ScaledAlong
from diffabs.parts.roads.burckhardt import DRY_ASPHALT as DRY_ASPHALT
from diffabs.parts.roads.burckhardt import DRY_COBBLESTONE as DRY_COBBLESTONE
from diffabs.parts.roads.burckhardt import DRY_CONCRETE as DRY_CONCRETE
from diffabs.parts.roads.burckhardt import ICE as ICE
from diffabs.parts.roads.burckhardt import SNOW as SNOW
from diffabs.parts.roads.burckhardt import WET_ASPHALT as WET_ASPHALT
from diffabs.parts.roads.burckhardt import WET_COBBLESTONE as WET_COBBLESTONE
from diffabs.parts.roads.burckhardt import Burckhardt as Burckhardt
from diffabs.parts.roads.magic_formula import MagicFormula as MagicFormula
from diffabs.parts.roads.optimum import Peak as Peak
from diffabs.parts.roads.optimum import peak as peak
from diffabs.parts.roads.patches import Patches as Patches
from diffabs.parts.roads.patches import Scaled as Scaled
from diffabs.parts.roads.piecewise_linear import PiecewiseLinear as PiecewiseLinear
from diffabs.parts.roads.rational import RIG as RIG
from diffabs.parts.roads.rational import RIG_UNROUNDED as RIG_UNROUNDED
from diffabs.parts.roads.rational import RationalCurve as RationalCurve
from diffabs.parts.roads.tabulated import SPLINE_B as SPLINE_B
from diffabs.parts.roads.tabulated import Tabulated as Tabulated
from diffabs.parts.roads.tyres import PacejkaTyre as PacejkaTyre
from diffabs.parts.roads.tyres import RelaxedTyre as RelaxedTyre
from diffabs.parts.roads.tyres import RoadTyre as RoadTyre
