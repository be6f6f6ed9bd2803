"""Controllers: blocks that map (target, measured, feedforward) to the command."""

from diffabs.core.blocks import NoFeedforward as NoFeedforward
from diffabs.parts.controllers.antiwindup import BackCalculation as BackCalculation
from diffabs.parts.controllers.antiwindup import Clamping as Clamping
from diffabs.parts.controllers.antiwindup import NoAntiWindup as NoAntiWindup
from diffabs.parts.controllers.balance import BalanceFeedback as BalanceFeedback
from diffabs.parts.controllers.balance import ObserverFeedback as ObserverFeedback
from diffabs.parts.controllers.cascade import Cascade as Cascade
from diffabs.parts.controllers.driver import HoldCourse as HoldCourse
from diffabs.parts.controllers.feedback import StateFeedback as StateFeedback
from diffabs.parts.controllers.feedforward import ConstantInput as ConstantInput
from diffabs.parts.controllers.feedforward import HoldingInput as HoldingInput
from diffabs.parts.controllers.gain_schedule import ProportionalFeedback as ProportionalFeedback
from diffabs.parts.controllers.gain_schedule import ScheduledFeedback as ScheduledFeedback
from diffabs.parts.controllers.matrix_feedback import MatrixFeedback as MatrixFeedback
from diffabs.parts.controllers.matrix_feedback import ObservedFeedback as ObservedFeedback
from diffabs.parts.controllers.per_channel import PerChannel as PerChannel
from diffabs.parts.controllers.per_channel import SelectLow as SelectLow
from diffabs.parts.controllers.pid import PID as PID
from diffabs.parts.controllers.playback import PlayedCommand as PlayedCommand
from diffabs.parts.controllers.sampled import Sampled as Sampled
from diffabs.parts.controllers.sampled_on_grid import SampledOnGrid as SampledOnGrid
from diffabs.parts.controllers.switching import ConstantTorque as ConstantTorque
from diffabs.parts.controllers.switching import Relay as Relay
from diffabs.parts.controllers.switching import SlidingMode as SlidingMode
from diffabs.parts.controllers.torque_logic import BandLogic as BandLogic
from diffabs.parts.controllers.torque_logic import FourPhase as FourPhase
