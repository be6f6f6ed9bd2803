"""Frequency responses with derivatives: peaks, margins and norms of loops as JAX functions, one loop or many."""

from diffabs.linear.responses.loop_margins import Margin as Margin
from diffabs.linear.responses.loop_margins import complementary_peak as complementary_peak
from diffabs.linear.responses.loop_margins import delay_margin as delay_margin
from diffabs.linear.responses.loop_margins import disk_margin as disk_margin
from diffabs.linear.responses.loop_margins import gain_margins as gain_margins
from diffabs.linear.responses.loop_margins import phase_margin as phase_margin
from diffabs.linear.responses.loop_margins import sensitivity_peak as sensitivity_peak
from diffabs.linear.responses.norms import h2_norm as h2_norm
from diffabs.linear.responses.norms import hinf_norm as hinf_norm
from diffabs.linear.responses.opening import open_transfer as open_transfer
from diffabs.linear.responses.opening import sampled_delay_margin as sampled_delay_margin
from diffabs.linear.responses.search import FrequencyPeak as FrequencyPeak
from diffabs.linear.responses.structured import Mu as Mu
from diffabs.linear.responses.structured import structured_singular_value as structured_singular_value
