"""Numbers that a person types: no underscores and no digits of other scripts, wherever they are read."""

import pytest

from diffabs.cli import margins, options
from diffabs.host.values import ScenarioError
from diffabs.output.explore.session import Session
from diffabs.scenario import proving
from diffabs.scenario.scenario import load

STRANGE = ["1_0", "\uff11\uff10", "\u0661\u0660", "1\u00a00"]  # Python's `float` takes the first three


@pytest.fixture(scope="module")
def chosen():
    return load("slip-lmi", integrated=False)


@pytest.mark.parametrize("text", STRANGE)
def test_a_number_of_an_option_has_plain_digits(chosen, text):
    with pytest.raises(ScenarioError, match="a number is needed"):
        margins._read_places(chosen, [f"speed={text}"])
    with pytest.raises(ScenarioError, match="numbers are needed"):
        proving.read_gain(f"-1,{text}", ("a", "b"))
    with pytest.raises(ScenarioError, match="is not of the form path=low:high"):
        options.read_sides([f"plant.mass=5:{text}"], chosen)


@pytest.mark.parametrize("text", STRANGE)
def test_a_number_of_the_explorer_has_plain_digits(text):
    session = Session("slip-lmi")
    with pytest.raises(ScenarioError, match=r"plant\.mass = .* is text; a number in"):
        session.knobs["plant.mass"].read(text)
    with pytest.raises(ScenarioError, match=r"fan\.mass = .* is text; a number in"):
        session.widen("mass", text)
    assert session.knobs["plant.mass"].read(" 6.5 ") == 6.5
