"""Controllers: blocks that map (target, measured, feedforward) to the command."""

from diffabs.controllers.antiwindup import BackCalculation as BackCalculation
from diffabs.controllers.antiwindup import Clamping as Clamping
from diffabs.controllers.antiwindup import NoAntiWindup as NoAntiWindup
from diffabs.controllers.balance import BalanceFeedback as BalanceFeedback
from diffabs.controllers.balance import ObserverFeedback as ObserverFeedback
from diffabs.controllers.cascade import Cascade as Cascade
from diffabs.controllers.feedback import StateFeedback as StateFeedback
from diffabs.controllers.feedforward import ConstantInput as ConstantInput
from diffabs.controllers.feedforward import HoldingInput as HoldingInput
from diffabs.controllers.gain_schedule import ProportionalFeedback as ProportionalFeedback
from diffabs.controllers.gain_schedule import ScheduledFeedback as ScheduledFeedback
from diffabs.controllers.pid import PID as PID
from diffabs.controllers.playback import PlayedCommand as PlayedCommand
from diffabs.controllers.sampled import Sampled as Sampled
from diffabs.controllers.sampled_on_grid import SampledOnGrid as SampledOnGrid
from diffabs.controllers.switching import ConstantTorque as ConstantTorque
from diffabs.controllers.switching import Relay as Relay
from diffabs.controllers.switching import SlidingMode as SlidingMode
from diffabs.controllers.torque_logic import BandLogic as BandLogic
from diffabs.controllers.torque_logic import FourPhase as FourPhase
from diffabs.core.blocks import NoFeedforward as NoFeedforward
