"""Residuals of simulated against recorded motion, and their Jacobian by forward mode, segment by segment."""

from __future__ import annotations

import copy
import dataclasses
import math
from numbers import Real
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.fit.arrays import rotation_between
from mathota_jax.fit.initial_states import CHART, Motion, changed, difference, guesses, motion_of, with_motion
from mathota_jax.fit.parameters import ParameterVector
from mathota_jax.fit.trajectories import CHANNELS, Trajectories
from mathota_jax.model import Model
from mathota_jax.state import State
from mathota_jax.step import step

PULL = "pull"
"""Key of `Segments.pull` beside the channels."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of the recorded channels, by which residuals are divided.

    Their common factor does not matter to estimates and intervals, which scale with the residuals found.

    Attributes:
        position: [m].
        orientation: of each component of the rotation vector [rad].
        velocity: [m/s]; None leaves recorded velocities out of the residuals.
        angular_velocity: [rad/s]; None likewise.
    """

    position: float = 1e-3
    orientation: float = math.radians(1.0)
    velocity: float | None = None
    angular_velocity: float | None = None

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is None and field.name in ("velocity", "angular_velocity"):
                continue
            object.__setattr__(self, field.name, _positive(f"Noise.{field.name}", value))


@dataclasses.dataclass(frozen=True)
class Spread:
    """Standard deviations of what was not recorded at the beginning of a trajectory, about the state of the scene.

    Orientations that no one recorded are unknowns like all others. Left to themselves they explain anything: a puck of which
    the positions are known slides as far with more friction if it spins on its edge. Where the data do tell of them, these
    widths hardly matter. Bodies in joints are left to themselves: where one is told where it is, another can not stay.

    Attributes:
        position: [m].
        orientation: of each component of the rotation vector [rad].
        velocity: [m/s].
        angular_velocity: [rad/s].
    """

    position: float = 0.01
    orientation: float = 0.1
    velocity: float = 0.1
    angular_velocity: float = 0.3

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, _positive(f"Spread.{field.name}", getattr(self, field.name)))


def _positive(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not (float(value) > 0 and math.isfinite(value)):
        raise ValueError(f"{name} must be a positive finite number, got {value!r}")
    return float(value)


class Segments(NamedTuple):
    """Recorded data cut into segments of equal length, NumPy.

    Attributes:
        start: guessed motion at the beginning of each segment, leaves (trajectory, segment, body, ...).
        observed: channel -> (trajectory, segment, frame, body, component), frame 0 being the beginning of the segment;
            NaN where nothing was recorded or another segment has the frame.
        action: (trajectory, segment, frame - 1, motor).
        pull: (trajectory, segment, chart) 1 / spread of the numbers of the beginnings that nothing was recorded of, else 0.
        frames: (segment, frame) index of each frame in the trajectory.
    """

    start: Motion
    observed: dict[str, np.ndarray]
    action: np.ndarray
    pull: np.ndarray
    frames: np.ndarray


class Linearised(NamedTuple):
    """Residuals and Jacobians of one set of starts; b starts, n trajectories, s segments, m residuals of a segment.

    Attributes:
        residual: (b, n, s, m) divided by the noise; 0 where nothing was recorded.
        by_parameters: (b, n, s, m, entry).
        by_start: (b, n, s, m, chart).
        gap: (b, n, s - 1, chart) jump from the end of each segment to the beginning of the next one.
        gap_by_parameters: (b, n, s - 1, chart, entry).
        gap_by_start, gap_by_next: (b, n, s - 1, chart, chart) by the chart of a segment and of the next one.
    """

    residual: Any
    by_parameters: Any
    by_start: Any
    gap: Any
    gap_by_parameters: Any
    gap_by_start: Any
    gap_by_next: Any


def cut(model: Model, state: State, data: Trajectories, segment_count: int, start: str, spread: Spread) -> Segments:
    """Segments of the data.

    Args:
        model: the scene.
        state: its initial state.
        data: recorded motions.
        segment_count: number of segments.
        start: "model": trajectories begin in the state of the scene; "recorded": in their first frame; "free": the first
            frame is a guess and its residuals count.
        spread: of what was not recorded, where the start is free.
    """
    steps = data.frame_count - 1
    length = -(-steps // segment_count)
    begins = [k * length for k in range(segment_count)]
    frames = np.arange(length + 1)[None] + np.asarray(begins)[:, None]
    inside = np.minimum(frames, data.frame_count - 1)
    observed = {}
    for name, value in data.channels.items():
        part = value[:, inside].copy()
        part[:, frames >= data.frame_count] = np.nan
        part[:, 1:, 0] = np.nan  # predicted by the segment before
        if start != "free":
            part[:, 0, 0] = np.nan
        observed[name] = part
    motions, told = guesses(model, state, data, [min(begin, steps) for begin in begins], start == "recorded")
    if start == "model":
        for leaf, given in zip(motions, motion_of(state), strict=True):
            leaf[:, 0] = np.asarray(given)
    motors = len(model.scene.motors)
    action = np.zeros((data.count, segment_count, length, motors))
    if data.action is not None:
        padded = np.concatenate([data.action, np.zeros((data.count, 1, motors))], 1)
        action = padded[:, np.minimum(frames[:, :-1], steps)]
    pull = np.zeros((data.count, segment_count, len(model.scene.dynamic_bodies), len(motions), 3))
    if start == "free":
        widths = np.array([getattr(spread, leaf) for leaf in Motion._fields])
        loose = [body not in model.scene.jointed for body in model.scene.dynamic_bodies]
        unknown = ~told[:, 0, list(model.scene.dynamic_bodies)] & np.array(loose, bool)[:, None, None]
        pull[:, 0] = np.where(unknown, 1.0 / widths[:, None], 0.0)
    return Segments(motions, observed, action, pull.reshape(data.count, segment_count, -1), frames)


class Objective:
    """The residuals of a fit as functions of parameters and of charts of the beginnings; compiled once.

    Args:
        model, state: the scene as built.
        vector: parameters.
        data: recorded motions.
        noise: divides the residuals.
        segment_count: of multiple shooting; 1 for single shooting.
        substeps: steps of the engine between two frames.
        start, spread: see `cut`.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        vector: ParameterVector,
        data: Trajectories,
        noise: Noise,
        segment_count: int,
        substeps: int,
        start: str,
        spread: Spread,
    ) -> None:
        self.model = dataclasses.replace(model, dt=jnp.asarray(data.dt / substeps, model.dt.dtype))
        self.state, self.vector, self.noise, self.substeps = state, vector, noise, substeps
        self.recorded = tuple(model.scene.body_names.index(body) for body in data.bodies)
        self.moving = model.scene.dynamic_bodies
        self.used = [name for name in CHANNELS if name in data.channels and getattr(noise, name) is not None]
        self.start, self.spread, self.segment_count = start, spread, segment_count
        self.chart_size = CHART * len(self.moving)
        self._residuals = jax.jit(jax.vmap(self._residuals_of_all, (0, 0, None, None, None)))
        self._linearise = jax.jit(jax.vmap(self._linearise_all, (0, 0, None, None, None)))
        self._take_data(data)

    def _take_data(self, data: Trajectories) -> None:
        self.data = data
        self.segments = cut(self.model, self.state, data, self.segment_count, self.start, self.spread)
        self._arrays = jax.tree.map(
            lambda x: jnp.asarray(x, self.state.position.dtype),
            (
                self.segments.start,
                {name: self.segments.observed[name] for name in self.used} | {PULL: self.segments.pull},
                self.segments.action,
            ),
        )

    def with_data(self, data: Trajectories) -> Objective:
        """The same for other data of the same bodies, channels and shape; nothing is compiled again."""
        other = copy.copy(self)
        other._take_data(data)
        return other

    @property
    def mask(self) -> np.ndarray:
        """(trajectory, segment, residual) whether something was recorded, or is pulled towards the scene."""
        parts = [self._flat(~np.isnan(self.segments.observed[name]), name) for name in self.used]
        parts.append(self.segments.pull > 0)
        return np.concatenate(parts, -1)

    @property
    def pulls(self) -> np.ndarray:
        """(residual,) which of them pull beginnings towards the scene: the last ones."""
        count = self.segments.pull.shape[-1]
        return np.arange(self.mask.shape[-1]) >= self.mask.shape[-1] - count

    @property
    def frame_of_residual(self) -> np.ndarray:
        """(segment, residual) the frame that each residual belongs to."""
        parts = []
        for name in self.used:
            count = len(self.recorded) * _width(name)
            parts.append(np.repeat(self.segments.frames, count, axis=1))
        parts.append(np.repeat(self.segments.frames[:, :1], self.chart_size, axis=1))
        return np.concatenate(parts, -1)

    def _flat(self, value: np.ndarray, name: str) -> np.ndarray:
        """Entries of a channel in the order of the residuals; a quaternion gives three."""
        value = value[..., : _width(name)]
        return value.reshape(*value.shape[:2], -1)

    def by_channel(self, residual: np.ndarray) -> dict[str, np.ndarray]:
        """Residuals (trajectory, segment, residual) as channel -> (trajectory, frame, body, 3); NaN where not recorded."""
        masked = np.where(self.mask, residual, np.nan)
        found, offset = {}, 0
        for name in self.used:
            shape = (*self.segments.frames.shape, len(self.recorded), _width(name))
            size = math.prod(shape[1:])
            part = masked[..., offset : offset + size].reshape(len(masked), *shape)
            offset += size
            # Frame 0 of every segment but the first belongs to the one before.
            joined = [part[:, 0, :1], *(part[:, k, 1:] for k in range(shape[0]))]
            found[name] = np.concatenate(joined, 1)[:, : self.data.frame_count]
        return found

    def pulled(self, charts: np.ndarray) -> dict[tuple[str, str], float]:
        """How far beginnings (n, s, chart) lie off the scene in what was not recorded: (body, what) -> largest [spread]."""
        shape = (len(charts), len(self.moving), len(Motion._fields), 3)
        away = np.abs(self.segments.pull[:, 0] * charts[:, 0]).reshape(shape).max((0, 3))
        held = np.asarray((self.segments.pull[:, 0] > 0).reshape(shape).any(0)).tolist()
        found = {}
        for place, body in enumerate(self.moving):
            for number, leaf in enumerate(Motion._fields):
                axes = [axis for axis, part in zip("xyz", held[place][number], strict=True) if part]
                what = leaf.replace("_", " ") + (f" ({', '.join(axes)})" if 0 < len(axes) < 3 else "")
                found[self.model.scene.body_names[body], what] = float(away[place, number])
        return found

    @property
    def start_arrays(self) -> Motion:
        """Guessed beginnings, leaves (trajectory, segment, body, ...), arrays of the device."""
        return self._arrays[0]

    def beginning(self, unbounded: Any, chart: Any, start: Motion) -> Motion:
        """Motion at the beginning of a segment: the guess, moved by the chart; or what the parameters say."""
        if self.vector.initial:
            start = motion_of(self.vector.apply(self.model, self.state, unbounded)[1])
        return changed(start, chart, self.moving)

    def predict(self, unbounded: Any, chart: Any, start: Motion, action: Any) -> tuple[Motion, Motion]:
        """Motion of the frames of one segment (leading axis: frame, the beginning included) and of its end."""
        model, state = self.vector.apply(self.model, self.state, unbounded)
        state = with_motion(state, self.beginning(unbounded, chart, start))

        def frame(state: State, effort: Array) -> tuple[State, Motion]:
            if self.substeps == 1:
                state = step(model, state, effort)
            else:
                state, _ = jax.lax.scan(lambda s, _: (step(model, s, effort), None), state, None, length=self.substeps)
            return state, motion_of(state)

        final, later = jax.lax.scan(frame, state, action)
        first = motion_of(state)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later), motion_of(final)

    def _segment(self, unbounded: Any, chart: Any, start: Motion, observed: Any, action: Any) -> tuple[Array, Motion]:
        """Residuals of one segment and its final motion."""
        motion, final = self.predict(unbounded, chart, start, action)
        index = jnp.asarray(self.recorded)
        predicted = dict(zip(CHANNELS, motion, strict=True))
        parts = []
        for name in self.used:
            seen, simulated = observed[name], predicted[name][:, index]
            known = ~jnp.isnan(seen)
            # The double where: no NaN may enter the derivative.
            seen = jnp.where(known, seen, jax.lax.stop_gradient(simulated))
            if name == "orientation":
                error, known = rotation_between(seen, simulated), known[..., :3]
            else:
                error = simulated - seen
            parts.append(jnp.ravel(jnp.where(known, error, 0.0)) / getattr(self.noise, name))
        parts.append(observed[PULL] * chart)
        return jnp.concatenate(parts), final

    def residuals(self, unbounded: Any, charts: Any) -> tuple[Array, Array]:
        """Residuals (b, n, s, m) and jumps (b, n, s - 1, chart) at (b, entry) and (b, n, s, chart); compiled."""
        return self._residuals(*self._as_arrays(unbounded, charts), *self._arrays)

    def _residuals_of_all(self, unbounded: Any, charts: Any, start: Motion, observed: Any, action: Any) -> Any:
        def one(unbounded: Any, charts: Any, start: Motion, observed: Any, action: Any) -> tuple[Array, Array]:
            residual, final = jax.vmap(self._segment, (None, 0, 0, 0, 0))(unbounded, charts, start, observed, action)
            if self.segment_count == 1:
                return residual, jnp.zeros((0, self.chart_size), charts.dtype)
            before, after = jax.tree.map(lambda x: x[:-1], final), jax.tree.map(lambda x: x[1:], start)
            return residual, jax.vmap(self._gap)(before, charts[1:], after)

        return jax.vmap(one, (None, 0, 0, 0, 0))(unbounded, charts, start, observed, action)

    def _gap(self, final: Motion, chart: Any, start: Motion) -> Array:
        return difference(changed(start, chart, self.moving), final, self.moving)

    def linearise(self, unbounded: Any, charts: Any) -> Linearised:
        """Residuals, jumps and their slopes at (b, entry) and (b, n, s, chart); compiled."""
        return self._linearise(*self._as_arrays(unbounded, charts), *self._arrays)

    def _linearise_all(self, unbounded: Any, charts: Any, start: Motion, observed: Any, action: Any) -> Linearised:
        def segment(unbounded: Any, chart: Any, start: Motion, observed: Any, action: Any) -> Any:
            def of(x: Any) -> Any:
                residual, final = self._segment(x[: self.vector.size], self._full(x, chart), start, observed, action)
                return (residual, final), (residual, final)

            x = jnp.concatenate([unbounded, chart]) if self._charts_move else unbounded
            return jax.jacfwd(of, has_aux=True)(x)

        def one(unbounded: Any, charts: Any, start: Motion, observed: Any, action: Any) -> Linearised:
            (slope, final_slope), (residual, final) = jax.vmap(segment, (None, 0, 0, 0, 0))(
                unbounded, charts, start, observed, action
            )
            jumps = self._linear_gaps(charts, start, final, final_slope)
            size = self.vector.size
            return Linearised(residual, slope[..., :size], slope[..., size:], *jumps)

        return jax.vmap(one, (None, 0, 0, 0, 0))(unbounded, charts, start, observed, action)

    def _linear_gaps(self, charts: Any, start: Motion, final: Motion, final_slope: Motion) -> tuple[Array, ...]:
        """The jumps between segments and their slopes by parameters, by the segment and by the next one."""
        size, chart = self.vector.size, self.chart_size
        if self.segment_count == 1:
            widths = ((), (size,), (chart,), (chart,))
            return tuple(jnp.zeros((0, chart, *width), charts.dtype) for width in widths)
        before, after = jax.tree.map(lambda x: x[:-1], final), jax.tree.map(lambda x: x[1:], start)
        gap = jax.vmap(self._gap)(before, charts[1:], after)
        by_final = jax.vmap(jax.jacfwd(self._gap))(before, charts[1:], after)
        by_next = jax.vmap(jax.jacfwd(self._gap, argnums=1))(before, charts[1:], after)
        total = jnp.zeros((*gap.shape, size + chart), charts.dtype)
        for outer, inner in zip(by_final, final_slope, strict=True):
            outer, inner = outer.reshape(*gap.shape, -1), inner[:-1]
            total += jnp.einsum("sgk,skx->sgx", outer, inner.reshape(len(gap), -1, size + chart))
        return gap, total[..., :size], total[..., size:], by_next

    @property
    def _charts_move(self) -> bool:
        """Whether any beginning is free; if none is, nothing is differentiated by it."""
        return self.start == "free" or self.segment_count > 1

    def _full(self, x: Any, chart: Any) -> Any:
        return x[self.vector.size :] if self._charts_move else chart

    def _as_arrays(self, *values: Any) -> list[Array]:
        return [jnp.asarray(value, self.state.position.dtype) for value in values]

    def zero_charts(self, start_count: int) -> np.ndarray:
        """The guesses themselves (b, n, s, chart)."""
        return np.zeros((start_count, self.data.count, self.segment_count, self.chart_size))


def _width(name: str) -> int:
    return min(CHANNELS[name], 3)
