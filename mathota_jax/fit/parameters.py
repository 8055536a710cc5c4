"""The parameters of a fit: chosen by name, checked against the scene, packed into one unbounded vector."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mathota_jax.fit import transforms
from mathota_jax.fit.quantities import QUANTITIES, Quantity
from mathota_jax.fit.transforms import Transform
from mathota_jax.model import Model
from mathota_jax.state import State

NAME = re.compile(r"(\w+)(?:\[(.+)\])?")
SPREAD = 0.5
"""Standard deviation of random starts along an unbounded number, when no two bounds say where to look."""
FLAT = 20.0
"""How far unbounded numbers go towards a bound: to 2e-9 of the range, or of the start. Beyond, transforms are flat."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter to fit.

    Attributes:
        name: such as "friction[cube]", "mass[cube]", "inertia_scale[cube]", "gravity", "joint_damping[elbow]": a key of
            `QUANTITIES` and in brackets the body, joint or motor (by name or handle). A tuple of names ties their values:
            ``("friction[cube]", "friction[ground]")`` is one number.
        lower, upper: open bounds; None for those of physics.
        start: where to begin; None for the value in the model, 1 for factors.
        transform: "identity", "log", "softplus" or "logit"; None for what suits the bounds. Two bounds need "logit" or
            None, and moments of inertia are always kept physically consistent.
    """

    name: str | tuple[str, ...]
    lower: float | None = None
    upper: float | None = None
    start: Any = None
    transform: str | None = None

    @property
    def label(self) -> str:
        """Name in reports."""
        return self.name if isinstance(self.name, str) else " = ".join(self.name)


class Place(NamedTuple):
    """A parameter in the vector: where its values are written, and entries `begin` to `end`."""

    label: str
    targets: tuple[tuple[Quantity, int], ...]
    transform: Transform
    start: np.ndarray
    bounds: tuple[float, float]
    begin: int
    end: int
    order: int


class ParameterVector(NamedTuple):
    """All parameters of a fit as one vector.

    Attributes:
        places: of the parameters, in the order given.
        labels: of each entry of the vector; those of a parameter with several values end in [0], [1], ...
    """

    places: tuple[Place, ...]
    labels: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of entries."""
        return len(self.labels)

    @property
    def start(self) -> np.ndarray:
        """(entry,) unbounded, float64."""
        return np.concatenate([np.ravel(p.transform.to_unbounded(p.start)) for p in self.places] or [np.zeros(0)])

    @property
    def initial(self) -> bool:
        """Whether some parameter is part of the initial state."""
        return any(quantity.initial for place in self.places for quantity, _ in place.targets)

    def values(self, unbounded: Any) -> Any:
        """(entry,) values of the parameters; JAX."""
        parts = [
            jnp.ravel(place.transform.to_value(jnp.reshape(unbounded[place.begin : place.end], place.start.shape)))
            for place in self.places
        ]
        return jnp.concatenate(parts) if parts else jnp.zeros(0)

    def apply(self, model: Model, state: State, unbounded: Any) -> tuple[Model, State]:
        """The model and state with the parameters in place; differentiable in `unbounded` (entry,)."""
        for place in sorted(self.places, key=lambda place: place.order):
            value = place.transform.to_value(jnp.reshape(unbounded[place.begin : place.end], place.start.shape))
            for quantity, index in place.targets:
                model, state = quantity.write(model, state, index, value)
        return model, state

    def off_bounds(self, unbounded: np.ndarray) -> np.ndarray:
        """(..., entry) the same values, with numbers that ran away towards a bound brought back to where slopes are left."""
        found = unbounded.copy()
        for place in self.places:
            part = found[..., place.begin : place.end]
            if place.transform.name == "logit":
                np.clip(part, -FLAT, FLAT, out=part)
            elif place.transform.name != "identity":
                np.maximum(part, np.minimum(np.ravel(place.transform.to_unbounded(place.start)), 0.0) - FLAT, out=part)
        return found

    def random_starts(self, count: int, seed: int) -> np.ndarray:
        """(start, entry) unbounded: the given start, then random ones, uniform between bounds where there are two."""
        generator = np.random.default_rng(seed)
        rows = [self.start]
        for _ in range(count - 1):
            parts = []
            for place in self.places:
                lower, upper = place.bounds
                if place.transform.name == "logit":
                    parts.append(place.transform.to_unbounded(generator.uniform(lower, upper, place.start.shape)))
                else:
                    begin = place.transform.to_unbounded(place.start)
                    parts.append(begin + SPREAD * generator.normal(size=place.start.shape))
            rows.append(np.concatenate([np.ravel(part) for part in parts]))
        return np.stack(rows)


def parameter_vector(model: Model, state: State, parameters: Sequence[Parameter | str]) -> ParameterVector:
    """Checks the parameters against the scene.

    Raises:
        ValueError: an unknown quantity, body, joint or motor; one that the scene lacks; bounds that are empty, beyond
            those of physics, or exclude the start; a parameter that is named twice.
    """
    if isinstance(parameters, str) or not parameters:
        raise ValueError("fit: parameters must be a list of at least one Parameter or name")
    places: list[Place] = []
    labels: list[str] = []
    seen: set[tuple[str, int]] = set()
    for given in parameters:
        parameter = Parameter(given) if isinstance(given, str) else given
        if not isinstance(parameter, Parameter):
            raise ValueError(f"fit: parameters must be Parameter or names, got {parameter!r}")
        place = _place(model, state, parameter, len(labels), seen)
        places.append(place)
        count = place.end - place.begin
        labels += [place.label] if count == 1 else [f"{place.label}[{k}]" for k in range(count)]
    return ParameterVector(tuple(places), tuple(labels))


def _place(model: Model, state: State, parameter: Parameter, begin: int, seen: set[tuple[str, int]]) -> Place:
    names = (parameter.name,) if isinstance(parameter.name, str) else parameter.name
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"fit: the name of a Parameter must be a string or a tuple of them, got {parameter.name!r}")
    if not names:
        raise ValueError("fit: a tied parameter needs at least one name, got ()")
    targets, kinds = [], []
    for name in names:
        kind, quantity, index = _target(model, name)
        if (kind, index) in seen:
            raise ValueError(f"fit: parameter '{name}' is given twice")
        seen.add((kind, index))
        targets.append((quantity, index))
        kinds.append(kind)
    if len(set(kinds)) > 1:
        raise ValueError(f"fit: tied parameters must be of one quantity, got {', '.join(names)}")
    quantity, index = targets[0]
    own = quantity.read(model, state, index)
    start = _numbers("start", parameter, own if parameter.start is None else parameter.start)
    shape = np.shape(own)
    if start.shape != shape and start.shape != ():
        raise ValueError(f"fit: start of '{parameter.label}' must have shape {shape}, got {start.shape}")
    start = np.broadcast_to(start, shape)
    transform, bounds = _transform(parameter, quantity, start)
    return Place(
        parameter.label,
        tuple(targets),
        transform,
        start,
        bounds,
        begin,
        begin + start.size,
        list(QUANTITIES).index(kinds[0]),
    )


def _target(model: Model, name: Any) -> tuple[str, Quantity, int]:
    """The quantity that a name stands for and the index of its owner."""
    found = NAME.fullmatch(name) if isinstance(name, str) else None
    if found is None or found[1] not in QUANTITIES:
        raise ValueError(f"fit: unknown parameter {name!r}; known quantities: {', '.join(QUANTITIES)}")
    kind, owner = found[1], found[2]
    quantity = QUANTITIES[kind]
    if quantity.owner == "scene":
        if owner is not None:
            raise ValueError(f"fit: '{kind}' belongs to the whole scene; write it without brackets, got '{name}'")
        index = 0
    else:
        index = _owner(model, name, quantity.owner, owner)
    missing = quantity.missing(model, index)
    if missing:
        raise ValueError(f"fit: parameter '{name}': {missing}")
    return kind, quantity, index


def _numbers(what: str, parameter: Parameter, value: Any) -> np.ndarray:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"fit: {what} of '{parameter.label}' must be a number, got {value!r}") from None


def _owner(model: Model, name: str, noun: str, owner: str | None) -> int:
    scene = model.scene
    known = {
        "body": scene.body_names,
        "joint": scene.joint_names,
        "motor": tuple(scene.joint_names[motor.joint] for motor in scene.motors),
    }[noun]
    listed = ", ".join(f"'{entry}'" for entry in known) or "none"
    if owner is None:
        raise ValueError(f"fit: parameter '{name}' needs a {noun} in brackets; known: {listed}")
    if owner in known:
        return known.index(owner)
    if owner.isdecimal() and int(owner) < len(known):
        return int(owner)
    raise ValueError(f"fit: parameter '{name}': no {noun} is called '{owner}'; known: {listed}")


def _transform(parameter: Parameter, quantity: Quantity, start: np.ndarray) -> tuple[Transform, tuple[float, float]]:
    label = parameter.label
    lower, upper = (
        own if given is None else float(_numbers(f"bound '{name}'", parameter, given))
        for name, own, given in (
            ("lower", quantity.lower, parameter.lower),
            ("upper", quantity.upper, parameter.upper),
        )
    )
    if not lower < upper or lower < quantity.lower or upper > quantity.upper:
        raise ValueError(
            f"fit: bounds of '{label}' must be increasing and between {quantity.lower:g} and {quantity.upper:g}, "
            f"got {lower:g} and {upper:g}"
        )
    # A bound at the value of the scene is missed by the round-off of that: so close to it nothing moves.
    off = 1e-6 * np.abs(start)
    if not np.all(np.isfinite(start)) or not np.all((start - off > lower) & (start + off < upper)):
        raise ValueError(
            f"fit: the start of '{label}' must lie strictly between its bounds {lower:g} and {upper:g}, got "
            f"{start.tolist()}; give another start or wider bounds"
        )
    if quantity.transform == "moments":
        if parameter.transform or parameter.lower is not None or parameter.upper is not None:
            raise ValueError(f"fit: '{label}' is kept physically consistent and takes neither bounds nor a transform")
        if not np.all(start < start.sum() / 2):
            raise ValueError(
                f"fit: start of '{label}': each moment must be less than the sum of the others, got {start}"
            )
        return transforms.moments(), (lower, upper)
    asked = parameter.transform
    if asked is not None and asked not in transforms.NAMES:
        raise ValueError(f"fit: transform of '{label}' must be one of {', '.join(transforms.NAMES)}, got {asked!r}")
    if math.isfinite(lower) and math.isfinite(upper):
        if asked not in (None, "logit"):
            raise ValueError(f"fit: '{label}' has two bounds, which transform={asked!r} can not keep; use 'logit'")
        return transforms.logit(lower, upper), (lower, upper)
    if math.isfinite(lower):
        name = asked or (quantity.transform if quantity.transform in ("log", "softplus") else "softplus")
        if name not in ("log", "softplus"):
            raise ValueError(f"fit: '{label}' has a lower bound, which transform={asked!r} can not keep")
        return (transforms.log if name == "log" else transforms.softplus)(lower), (lower, upper)
    if math.isfinite(upper):
        raise ValueError(f"fit: '{label}' has an upper bound alone; give a lower one as well")
    if asked not in (None, "identity"):
        raise ValueError(f"fit: '{label}' has no bounds, so transform={asked!r} does not apply; give bounds")
    return transforms.identity(), (lower, upper)
