"""Signals of a loop with several inputs: NamedTuples by name, and the view that a part for one channel has of them.

    control, command, feed-forward    `plant.controls`: one field for each control
    target, setpoint                  one field for each output in `tracked` of the plant's output type
    output, measured                  all outputs

A channel is a control with the output that it controls, or one of the two. Parts for a single control and target, such
as a PID or the integral of the error, then work in one channel as they do in a loop of one: their signals are scalars,
and the output that they control is the first one.

A class of outputs may have a method `channel(name)`, which returns other outputs for one channel. A wheel's slip and
speed then have the names that a braking controller reads.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from diffabs.core.messages import Ending, Sample, Segment, Shown, Tracking, named_tuple
from diffabs.core.types import PyTree, Scalar


class Channels(Mapping[str, str]):
    """A mapping from each control to the output that it controls, in order, which cannot change."""

    def __init__(self, outputs: Mapping[str, str]):
        """Copy the names of a mapping."""
        self._outputs = dict(outputs)

    def __getitem__(self, control: str) -> str:
        """Return the output of a control."""
        return self._outputs[control]

    def __iter__(self) -> Iterator[str]:
        """Return an iterator over the controls."""
        return iter(self._outputs)

    def __len__(self) -> int:
        """Return the number of channels."""
        return len(self._outputs)

    def __hash__(self) -> int:
        """Return the same number for equal mappings in the same order: the mapping is a static field of parts."""
        return hash(tuple(self._outputs.items()))

    def __eq__(self, other: object) -> bool:
        """Return whether both have the same channels in the same order."""
        return isinstance(other, Channels) and tuple(self.items()) == tuple(other.items())

    def __repr__(self) -> str:
        """Return the text of the mapping."""
        return repr(self._outputs)


def has_channels(signal: object) -> bool:
    """Return whether a control or target has several channels."""
    return isinstance(signal, tuple) and hasattr(signal, "_fields")


def control_names(plant: object) -> tuple[str, ...]:
    """Return the names of a plant's controls; none for a plant with a single control."""
    return getattr(getattr(plant, "controls", None), "_fields", ())


def select_channel(signal: Any, name: str) -> Scalar:
    """Return one channel of a control or target; the signal of a loop with one channel is that channel."""
    if not has_channels(signal):
        return signal
    if name not in signal._fields:
        raise ValueError(f"there is no channel {name}; there is {', '.join(signal._fields)}")
    return getattr(signal, name)


def select_output(output: Any, name: str) -> Any:
    """Return the outputs as a part sees them that controls the output `name`: that one is the first."""
    if name not in (names := type(output)._fields):
        raise ValueError(f"{name} is no output of the plant; there is {', '.join(names)}")
    return output.channel(name) if hasattr(output, "channel") else put_first(output, name)


def put_first(output: Any, name: str) -> Any:
    """Return the outputs with one of them, `name`, before the others."""
    order = (name, *(field for field in type(output)._fields if field != name))
    return named_tuple("ReorderedOutput", order)(*(getattr(output, field) for field in order))


def select_tracking(signal: Tracking, control: str, output: str) -> Tracking:
    """Return the input of a controller in one channel."""
    return Tracking(
        select_channel(signal.target, output),
        select_output(signal.measured, output),
        select_channel(signal.feedforward, control),
    )


def select_shown(shown: Shown, output: str) -> Shown:
    """Return outputs and setpoint of one channel, or their rates."""
    return Shown(select_output(shown.output, output), select_channel(shown.setpoint, output))


def select_sample(sample: Sample, control: str, output: str) -> Sample:
    """Return the signals of one channel; empty names are those of the first control and target."""
    control, output = _name_channel(sample, control, output)
    return Sample(
        sample.t,
        select_output(sample.output, output),
        select_channel(sample.target, output),
        select_channel(sample.setpoint, output),
        *(select_channel(signal, control) for signal in (sample.feedforward, sample.command, sample.control)),
    )


def _name_channel(sample: Sample, control: str, output: str) -> tuple[str, str]:
    """Return the names of a channel, with those of the first control and target in place of empty names."""
    controls, targets = (getattr(signal, "_fields", ("",)) for signal in (sample.control, sample.target))
    return control or controls[0], output or (targets[0] if has_channels(sample.target) else sample.output._fields[0])


def select_segment(segment: Segment, control: str, output: str) -> Segment:
    """Return a step of a run, as an objective sees it in one channel."""
    control, output = _name_channel(segment.start, control, output)

    def select(sample: Sample) -> Sample:
        return select_sample(sample, control, output)

    return segment._replace(
        start=select(segment.start),
        end=select(segment.end),
        shown_rates=lambda: tuple(select_shown(rates, output) for rates in segment.shown_rates()),
        sample_rates=lambda: tuple(map(select, segment.sample_rates())),
    )


def select_ending(ending: Ending, control: str, output: str) -> Ending:
    """Return the end of a run in one channel."""
    return ending._replace(sample=select_sample(ending.sample, control, output))


def zero_controls(plant: object, like: Scalar) -> PyTree:
    """Return a control of zero for a plant, with the type of the number `like`."""
    zero = 0.0 * like
    controls = getattr(plant, "controls", None)
    return zero if controls is None else controls(*(zero for _ in controls._fields))


def outputs_like(output: PyTree, target: PyTree) -> PyTree:
    """Return the outputs to which a target or setpoint refers, with its structure."""
    if not has_channels(target):
        return output[0]
    return type(target)(*(getattr(output, name) for name in target._fields))


def need_single_control(plant: object, purpose: str) -> None:
    """Raise a ValueError for a plant with several inputs; `purpose` says what needs a plant with one."""
    if controls := getattr(plant, "controls", None):
        names = ", ".join(controls._fields)
        raise ValueError(f"{purpose} needs a loop with one control; plant {type(plant).__name__} has {names}")
