"""Friction curves: `friction(slip, speed, distance) -> mu`."""

from diffabs.roads.along import ScaledAlong as ScaledAlong
from diffabs.roads.burckhardt import DRY_ASPHALT as DRY_ASPHALT
from diffabs.roads.burckhardt import DRY_COBBLESTONE as DRY_COBBLESTONE
from diffabs.roads.burckhardt import DRY_CONCRETE as DRY_CONCRETE
from diffabs.roads.burckhardt import ICE as ICE
from diffabs.roads.burckhardt import SNOW as SNOW
from diffabs.roads.burckhardt import WET_ASPHALT as WET_ASPHALT
from diffabs.roads.burckhardt import WET_COBBLESTONE as WET_COBBLESTONE
from diffabs.roads.burckhardt import Burckhardt as Burckhardt
from diffabs.roads.magic_formula import MagicFormula as MagicFormula
from diffabs.roads.optimum import Peak as Peak
from diffabs.roads.optimum import peak as peak
from diffabs.roads.patches import Patches as Patches
from diffabs.roads.patches import Scaled as Scaled
from diffabs.roads.piecewise_linear import PiecewiseLinear as PiecewiseLinear
from diffabs.roads.rational import RIG as RIG
from diffabs.roads.rational import RIG_UNROUNDED as RIG_UNROUNDED
from diffabs.roads.rational import RationalCurve as RationalCurve
from diffabs.roads.tabulated import SPLINE_B as SPLINE_B
from diffabs.roads.tabulated import Tabulated as Tabulated
