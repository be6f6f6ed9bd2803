"""Commands that other packages add by entry points of the group `diffabs.commands`."""

import importlib.metadata
import json
import sys
import types
from collections.abc import Iterator

import pytest
from commands import assert_one_error_line, run
from mutants import killed_by

from diffabs.cli import console, show, usage

MODULE = "commands_of_another_package"


def weigh(scenario: console.ScenarioName, as_json: console.Json = False) -> None:
    """Show the mass of a scenario's plant."""
    with console.end_on_errors():
        mass = float(console.load_scenario(scenario, None).loop.plant.mass)
        show.as_json({"mass": mass}) if as_json else print(mass)


weigh.example = "weigh slip-lmi"  # pyright: ignore


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package is installed that adds a command, one under the name of a command of the program, and a broken one."""
    module = types.ModuleType(MODULE)
    module.weigh = weigh  # pyright: ignore
    monkeypatch.setitem(sys.modules, MODULE, module)
    targets = {"weigh": f"{MODULE}:weigh", "simulate": f"{MODULE}:weigh", "broken": f"{MODULE}:missing"}
    points = [importlib.metadata.EntryPoint(name, value, usage.COMMAND_GROUP) for name, value in targets.items()]
    monkeypatch.setattr(
        usage.importlib.metadata, "entry_points", lambda group: [point for point in points if point.group == group]
    )
    usage._outside_commands.cache_clear()
    yield
    usage._outside_commands.cache_clear()


@killed_by("cli.usage", "            return _load_outside_command(point)\n", "            return None\n")
def test_another_package_adds_a_command() -> None:
    """It has the options of every command, and the program's own errors."""
    assert json.loads(run("weigh", "slip-lmi", "--json", "--quiet").stdout) == {"mass": 5.3}
    assert "diffabs weigh slip-lmi" in run("weigh", "--help").stdout
    assert_one_error_line(run("weigh", "nowhere", status=2))


@killed_by("cli.usage", "        return [*names, *sorted(", "        return [*names] or [*sorted(")
@killed_by("cli.usage", ".keys() - {*names})", ".keys())")
def test_the_help_lists_the_commands_of_other_packages_last() -> None:
    lines = run("--help").stdout.splitlines()
    commands = [line.split()[0] for line in lines[lines.index("Commands:") + 1 :] if line.startswith("  ")]
    assert commands[-2:] == ["broken", "weigh"]
    assert commands.count("simulate") == 1


def test_a_command_of_the_program_is_not_replaced() -> None:
    assert "Run a scenario once" in run("simulate", "--help").stdout


@killed_by("cli.usage", "    except Exception as error:", "    except KeyError as error:")
def test_a_command_that_cannot_be_loaded_is_one_line() -> None:
    result = run("broken", status=2)
    assert_one_error_line(result)
    assert f"broken cannot be loaded: {MODULE}:missing" in result.stderr
