"""TOML files to loops and tasks, and back: `load`, `loads`, `dump`, `names`, `Scenario`, `ScenarioError`."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffabs.scenario.scenario import Scenario as Scenario
    from diffabs.scenario.scenario import ScenarioError as ScenarioError
    from diffabs.scenario.scenario import dump as dump
    from diffabs.scenario.scenario import load as load
    from diffabs.scenario.scenario import loads as loads
    from diffabs.scenario.scenario import names as names

LAZY = ("Scenario", "ScenarioError", "dump", "load", "loads", "names")  # `import diffabs` only needs the usual loops


def __getattr__(name: str) -> Any:
    if name not in LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("diffabs.scenario.scenario"), name)
