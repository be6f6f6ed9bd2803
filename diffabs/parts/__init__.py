"""The blocks of a loop, by kind: plants, roads, controllers, references, actuators, sensors, stops and objectives.

A part is a pytree whose numbers are parameters; `core.protocols` says what each kind must do. The ring imports `core`
alone, and no part of another kind but roads, which plants stand on.

Read first: `plants/quarter_car.py`, `controllers/pid.py`, `objectives/braking.py`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.parts import actuators as actuators
    from diffabs.parts import controllers as controllers
    from diffabs.parts import objectives as objectives
    from diffabs.parts import plants as plants
    from diffabs.parts import references as references
    from diffabs.parts import roads as roads
    from diffabs.parts import sensors as sensors
    from diffabs.parts import stops as stops

__getattr__ = lazy_getattr(__name__)
