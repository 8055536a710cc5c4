"""The measuring tools measure: closed forms, apexes, interleaving, limits."""

import dataclasses

import numpy as np
import pytest

from tests.benchmarks import process, scenes
from tests.benchmarks.settings import QUICK
from tests.benchmarks.timing import Contestant, interleave, paired_ratio

DT = 1 / 240


def parabola_track(gap, dt=1e-4):
    """A drop and the bounce after it, from the equations of motion alone."""
    time = np.arange(0, scenes.BOUNCE_SECONDS, dt)
    impact = np.sqrt(2 * gap / scenes.GRAVITY)
    speed = scenes.BOUNCE_RESTITUTION * scenes.GRAVITY * impact
    after = time - impact
    fall, rise = gap - 0.5 * scenes.GRAVITY * time**2, speed * after - 0.5 * scenes.GRAVITY * after**2
    return np.where(after < 0, fall, rise)


def test_the_horizon_of_the_bounce_ends_before_the_second_impact():
    gaps = scenes.spread(scenes.BOUNCE_GAPS, 3)
    tracks = np.stack([parabola_track(gap) for gap in gaps], axis=1)
    assert tracks[-1].min() > 0
    errors = scenes.bounce_errors(gaps, scenes.first_apex(tracks))
    assert errors["apex_error"] < 1e-5


def test_a_wrong_apex_and_a_sphere_that_never_rises_are_seen():
    gaps = scenes.spread(scenes.BOUNCE_GAPS, 2)
    tracks = np.stack([parabola_track(gap) for gap in gaps], axis=1)
    assert scenes.bounce_errors(gaps, 0.9 * scenes.first_apex(tracks))["apex_error"] == pytest.approx(0.1, rel=1e-3)
    falling = np.linspace(1, 0, 50)[:, None]
    assert np.isnan(scenes.first_apex(falling)).all()


def test_slide_errors_against_an_integration_by_semi_implicit_euler():
    speed, distance, velocity = np.array([2.0]), 0.0, 2.0
    deceleration = scenes.SLIDE_FRICTION * scenes.GRAVITY
    while velocity > 0:
        velocity = max(0.0, velocity - deceleration * DT)
        distance += velocity * DT
    errors = scenes.slide_errors(speed, np.array([distance]), DT)
    assert errors["distance_error_euler"] < 1e-4
    assert errors["distance_error"] == pytest.approx(0.5 * 2.0 * DT / scenes.slide_distance(2.0), rel=0.02)


def test_every_speed_still_slides_during_the_timed_steps_and_rests_at_the_horizon():
    stops = np.array(scenes.SLIDE_SPEEDS) / (scenes.SLIDE_FRICTION * scenes.GRAVITY)
    assert stops.min() > scenes.SLIDE_TIMED_STEPS * DT
    assert stops.max() < scenes.SLIDE_SECONDS


def test_contestants_take_turns_and_ratios_are_paired():
    calls = []

    def block(name, seconds):
        def run():
            calls.append(name)
            sum(range(int(seconds * 1e7)))
            return 10

        return run

    contestants = {"slow": Contestant(block("slow", 0.02), {}, rounds=2), "fast": Contestant(block("fast", 0.005), {})}
    interleave(contestants, dataclasses.replace(QUICK, rounds=4, block_seconds=1e-9))
    warm = 2 * (QUICK.warmup_blocks + 1)
    assert calls[warm : warm + 4] == ["slow", "fast", "fast", "slow"]
    ratio = paired_ratio(contestants["fast"], contestants["slow"])
    assert ratio["count"] == 2
    assert ratio["median"] > 1.5


def test_a_measurement_that_hangs_or_fails_is_reported():
    with pytest.raises(process.MeasurementError, match="no result within"):
        process.launch("compile_time", dataclasses.replace(QUICK, timeout_seconds=0.01))
    with pytest.raises(process.MeasurementError, match="no_such_measurement"):
        process.launch("no_such_measurement", QUICK)
