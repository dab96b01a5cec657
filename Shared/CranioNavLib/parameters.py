"""Typed parameters: frozen dataclasses whose fields carry unit, limits and help in their type.

@dataclass(frozen=True)
class Settings(Parameters):
    rate_hz: Annotated[float, Limits(1, 1000), "poses a second"] = 60.0
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from CranioNavLib.errors import InputError

P = TypeVar("P", bound="Parameters")


@dataclass(frozen=True)
class Limits:
    """Smallest and largest value allowed, both included."""

    low: float
    high: float


@dataclass(frozen=True)
class ParameterInfo:
    """What a panel or a command line needs to know about one parameter."""

    name: str
    kind: type  # bool, int, float, str or an Enum
    default: Any
    limits: Limits | None
    help: str
    optional: bool

    @property
    def unit(self) -> str:
        """The unit that the name ends with (`rate_hz` -> "Hz"), or an empty string."""
        for ending, unit in UNITS.items():
            if self.name.endswith(ending):
                return unit
        return ""


UNITS = {
    "_m_s": "m/s",
    "_mm": "mm",
    "_deg": "°",
    "_ms": "ms",
    "_s": "s",
    "_mhz": "MHz",
    "_hz": "Hz",
    "_db": "dB",
    "_hu": "HU",
    "_us": "µs",
    "_ns": "ns",
}

IN_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Parameters:
    """Base of every plugin's and module's parameters; values are checked when one is made."""

    def __post_init__(self) -> None:
        for info in self.describe():
            value: Any = getattr(self, info.name)
            if value is None and info.optional:
                continue
            where = f"parameter {info.name}"
            if info.kind is float and isinstance(value, int) and not isinstance(value, bool):
                value = float(value)
                object.__setattr__(self, info.name, value)
            if not isinstance(value, info.kind) or (info.kind is not bool and isinstance(value, bool)):
                raise InputError(f"{where}: expected {IN_WORDS.get(info.kind, info.kind.__name__)}, got {value!r}")
            if info.limits and not info.limits.low <= float(getattr(self, info.name)) <= info.limits.high:
                raise InputError(f"{where} is {value}; expected {info.limits.low} to {info.limits.high} {info.unit}".rstrip())

    @classmethod
    def describe(cls) -> tuple[ParameterInfo, ...]:
        """One ParameterInfo a field, in order."""
        return _describe(cls)  # type: ignore[arg-type]  # a class is hashable, whatever its instances are

    @classmethod
    def from_strings(cls: type[P], values: dict[str, str]) -> P:
        """Parameters from `name=text` pairs, as a command line or a scene node holds them.

        Raises
        ------
        InputError
            An unknown name, or text that is not of the parameter's type or outside its limits.
        """
        known = {info.name: info for info in cls.describe()}
        parsed: dict[str, Any] = {}
        for name, text in values.items():
            if name not in known:
                raise InputError(f"unknown parameter {name!r}; known: {', '.join(known) or 'none'}")
            parsed[name] = _parse(known[name], text)
        return cls(**parsed)

    def to_strings(self) -> dict[str, str]:
        """The inverse of from_strings; parameters that are None are left out."""
        values = {info.name: getattr(self, info.name) for info in self.describe()}
        return {
            name: value.value if isinstance(value, Enum) else str(value) for name, value in values.items() if value is not None
        }


@functools.cache
def _describe(kind: type[Parameters]) -> tuple[ParameterInfo, ...]:
    """Kept for each class: live panels ask many times a second."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple(_describe_field(field, hints[field.name]) for field in dataclasses.fields(kind))


def _describe_field(field: dataclasses.Field[Any], hint: Any) -> ParameterInfo:
    extras: tuple[Any, ...] = ()
    if get_origin(hint) is Annotated:
        hint, *rest = get_args(hint)
        extras = tuple(rest)
    optional = False
    if get_origin(hint) is Union:  # Optional[...]; X | Y is not available in Slicer's Python 3.9
        hint, optional = next(kind for kind in get_args(hint) if kind is not type(None)), True
        if get_origin(hint) is Annotated:
            hint, *rest = get_args(hint)
            extras += tuple(rest)
    return ParameterInfo(
        name=field.name,
        kind=hint,
        default=field.default,
        limits=next((extra for extra in extras if isinstance(extra, Limits)), None),
        help=next((extra for extra in extras if isinstance(extra, str)), ""),
        optional=optional,
    )


def _parse(info: ParameterInfo, text: str) -> Any:
    try:
        if info.kind is bool:
            return {"true": True, "yes": True, "1": True, "on": True, "false": False, "no": False, "0": False, "off": False}[
                text.strip().lower()
            ]
        return info.kind(text)
    except (ValueError, KeyError):
        choices = (
            f"one of {', '.join(str(c.value) for c in info.kind)}"
            if issubclass(info.kind, Enum)
            else IN_WORDS.get(info.kind, info.kind.__name__)
        )
        raise InputError(f"parameter {info.name}: expected {choices}, got {text!r}") from None
