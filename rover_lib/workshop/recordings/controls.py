"""Read the controls of a recording: what the transmitter's pulses meant, and when they were measured.

The pulses are right in all recordings. Firmware has computed actions from them by two formulas: this car's, and an
older one. The duty is the pulse's share of its period.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from rover_lib.onboard.car.pwm import Channel, PwmCalibration
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import (
    BURST_MIN,
    CONTROL_FIELDS,
    arduino_step_s,
    driver_of,
    find_backlog,
    no_pulse,
    number_of,
)
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Episode
from rover_lib.workshop.untrusted import quote

EXACT = 1e-3  # an action agrees with a formula within this; recorded actions have 4 decimals
FOLLOWS = 0.9  # the share of readings that must agree
LEAST_READINGS = 8  # fewer do not show a formula, and are taken as recorded
HALF = 0.4, 0.6  # where the middle of steering is straight ahead if it lies from 0 to 1
FAR = 0.2  # of an action's unit: a pulse beyond the ends of its range by more is no jitter
Item = TypeVar("Item")
Rows = list[tuple[int, dict[str, float], str]]  # the number of a control, its numbers, and who drove
Actions = dict[int, float]  # of one channel, by the number of their control


# What the user's recorder wrote before October 2025, as the channels that it meant.
OLD = {
    "steering": replace(PwmCalibration().steering, neutral_pct=7.0, span_pct=2.42),
    "throttle": replace(PwmCalibration().throttle, neutral_pct=0.0, span_pct=70.0),
}


def _formula(channel: Channel) -> str:
    duty = f"(duty % - {channel.neutral_pct:.3g})" if channel.neutral_pct else "duty %"
    return f"{duty} / {channel.span_pct:.3g}"


def note_one_sided(episodes: Sequence[Episode], faults: Faults) -> None:
    """Add a fault if steering looks as if it were 0.5 straight ahead, as from 0 to 1 in some cars' files."""
    steering = np.array([s.chunk[0, 0] for s in chain.from_iterable(e.samples for e in episodes)])
    low, middle, high = np.quantile(steering, (0, 0.5, 1))
    if 0 <= low < HALF[0] <= middle <= HALF[1] < high:
        note = f"from {low:.2f} to {high:.2f}, half of it below {middle:.2f}: 0 must be straight ahead, is 0.5 here?"
        faults.add(faults.root, "one_sided_steering", note)


@dataclass(frozen=True)
class Control:
    """One reading. arduino_s may be NaN. Where nothing was measured, an action is None and its pulse is NaN."""

    system_s: float
    arduino_s: float
    actions: tuple[float | None, float | None]
    driver: str
    pulses_us: tuple[float, ...]


def read_controls(path: Path, rows: list, pwm: PwmCalibration, faults: Faults) -> tuple[list[Control], dict]:
    """Return the usable readings, by system time, and by channel the older formula that its actions had followed.

    Raises EpisodeError if a channel's actions follow no formula of its pulses.
    """
    read: Rows = []
    for i, row in enumerate(rows):
        if not isinstance(row, dict):
            faults.add(path, "wrong_type", f"control {i} is a {type(row).__name__}, not an object")
            continue
        lost = [name for name in ACTION_NAMES if no_pulse(row, name)]
        columns = [name for name in CONTROL_FIELDS if name.split("_")[0] not in lost]
        values = {n: number for n in columns if (number := number_of(row.get(n))) is not None}
        if bad := [name for name in columns if name not in values]:
            faults.add(path, "wrong_type", f"control {i}: {bad[0]} is {quote(row.get(bad[0]))}")
            continue  # the recorder did not write such a row, so nothing in it can be trusted
        if nan := [name for name, value in values.items() if math.isnan(value)]:
            faults.add(path, "not_finite", f"control {i}: {nan[0]} is {quote(row.get(nan[0]))}")
        if "system_timestamp" in nan:
            continue  # without a time it cannot be the action of a frame
        for name in lost:
            faults.add(path, f"{name}_no_pulse", f"control {i}: not measured; such values are missing, not 0")
        if (driver := driver_of(row)) is None:
            faults.add(path, "unknown_driver", f"control {i}: {quote(row.get('driver'))} drove; left out")
            continue
        read.append((i, values, driver))
    by_name = {name: _read_actions(pwm.channel(name), read, path, faults) for name in ACTION_NAMES}
    formulas = {name: _formula(older) for name, (*_, older) in by_name.items() if older}
    # Too few readings to show a formula are of older firmware too, if the other channel's are.
    actions = {}
    for name, (recorded, meant, _) in by_name.items():
        actions[name] = _take(pwm.channel(name), recorded, meant, bool(formulas), path, faults)
    controls = []
    for i, values, driver in read:
        pair = actions["steering"].get(i), actions["throttle"].get(i)
        pulses = tuple(values.get(f"{n}_raw_us", math.nan) if i in actions[n] else math.nan for n in ACTION_NAMES)
        times_s = values["system_timestamp"], values["arduino_timestamp"] / 1000
        controls.append(Control(*times_s, pair, driver, pulses))
    went_on = [arduino_step_s(a.arduino_s, b.arduino_s) > 0 for a, b in pairwise(controls)]
    return in_order([(c.system_s, c) for c in controls], went_on, path, "control", faults), formulas


def _read_actions(channel: Channel, rows: Rows, path: Path, faults: Faults) -> tuple[Actions, Actions, Channel | None]:
    """Return one channel's measured actions by the number of their control, as recorded and as their pulses mean them.

    And the older channel whose formula the recorded ones follow, if they do. Raises EpisodeError if they follow none.
    """
    name = channel.name
    old = replace(OLD[name], period_us=channel.period_us, by_pulse=channel.by_pulse)
    recorded = {}
    meant = {}
    of_old = {}
    pulses_us = {}
    for i, values, _ in rows:
        parts = [values.get(f"{name}_{part}", math.nan) for part in ("normalized", "raw_us", "period_us")]
        if any(map(math.isnan, parts)):
            continue  # not measured, or the caller has counted it, with the field's name
        action, pulse_us, period_us = parts
        expected = channel.action(pulse_us, period_us)
        if expected is None:
            kind = "zero_period" if period_us == 0 or pulse_us == 0 else "odd_period"
            note = f"control {i}: pulse {pulse_us:g} us of {period_us:g} us; such values are missing, not 0"
            faults.add(path, f"{name}_{kind}", note)
            continue
        recorded[i], meant[i], of_old[i] = action, expected, old.action(pulse_us, period_us) or 0.0
        # as at the nominal period, so that one limit in microseconds holds
        pulses_us[i] = pulse_us if channel.by_pulse else pulse_us / period_us * channel.period_us
    _refuse_other_pulses(channel, pulses_us)
    # Firmware may have been changed within a recording, so only what disagrees must follow the older formula.
    wrong = [i for i in recorded if abs(recorded[i] - meant[i]) > EXACT]
    follows_old = wrong and np.mean([abs(recorded[i] - of_old[i]) <= EXACT for i in wrong]) >= FOLLOWS
    unlike = len(recorded) >= LEAST_READINGS and len(wrong) > (1 - FOLLOWS) * len(recorded)
    if not follows_old and not unlike:
        return recorded, meant, None
    example = f"control {wrong[0]}: {recorded[wrong[0]]:g} recorded, its pulse says {meant[wrong[0]]:.4f}"
    if not follows_old:
        problem = f"{name} follows no known formula of its pulses: {len(wrong)} of {len(recorded)} neither "
        remedy = "correct them, say in metadata.car which car it is, or record again"
        problem += f"{_formula(old)} nor {_formula(channel)}, this car's"
        raise EpisodeError(problem, found=example, remedy=remedy, kind="no_formula")
    note = f"recorded as {_formula(old)} instead of {_formula(channel)}; {example}; recomputed from the pulses"
    faults.add(path, f"{name}_recomputed", note, len(wrong))
    return meant, meant, old


def _refuse_other_pulses(channel: Channel, pulses_us: dict[int, float]) -> None:
    """Raise EpisodeError if most pulses lie far beyond this car's: all would be recomputed as one end of its range."""
    (low_us, high_us), margin_us = channel.ends_us, FAR * channel.us_per_unit
    far = [i for i, us in pulses_us.items() if not low_us - margin_us <= us <= high_us + margin_us]
    count = len(pulses_us)
    if count >= LEAST_READINGS and 2 * len(far) > count:
        problem = f"{channel.name}: {len(far)} of {count} pulses lie far beyond this car's {low_us} to {high_us} us"
        remedy = "write pulses and periods in microseconds, or say which car it is in metadata.car"
        actual = f"{pulses_us[far[0]]:g} us in control {far[0]}"
        raise EpisodeError(problem, found=actual, remedy=remedy, kind="no_formula")


def _take(channel: Channel, recorded: Actions, meant: Actions, recompute: bool, path: Path, faults: Faults) -> Actions:
    """Return one channel's actions as recorded, or, if `recompute`, as their pulses mean them where these deny them."""
    for i, action in list(recorded.items()):
        kind = None
        if abs(action - meant[i]) > EXACT:
            kind = "recomputed" if recompute else "disagrees_with_pulse"
        if kind == "recomputed":
            recorded[i] = meant[i]
        elif not channel.low <= action <= channel.high:
            kind = "out_of_range"
            del recorded[i]
        if kind:
            note = f"control {i}: {action:g} recorded, its pulse says {meant[i]:.4f}"
            faults.add(path, f"{channel.name}_{kind}", note)
    return recorded


def place_bursts(controls: list[Control], path: Path, faults: Faults) -> list[Control]:
    """Give the controls of a serial burst the times at which they were measured, or drop them."""
    late = find_backlog([c.system_s for c in controls], [c.arduino_s for c in controls])
    ends = [i + 1 for i, is_late in enumerate(late) if not is_late]
    placed = list[Control]()
    shifted = 0
    dropped = 0
    farthest_s = 0.0
    for start, end in pairwise([0, *ends]):
        # A burst and the live control that ends it: the times of all others are not those of their measuring.
        *waited, after = controls[start:end]
        placed.append(after)
        if len(waited) < BURST_MIN:
            placed += reversed(waited)
            continue
        for remaining, control in reversed([*enumerate(waited, 1)]):
            step_s = arduino_step_s(control.arduino_s, after.arduino_s)
            if math.isnan(step_s):  # a restart, readings that were sent twice, or no number
                dropped += remaining
                break
            after = replace(control, system_s=after.system_s - step_s)
            farthest_s = max(farthest_s, control.system_s - after.system_s)
            placed.append(after)
            shifted += 1
    note = f"placed by the Arduino's clock, up to {farthest_s:.2f} s before they arrived"
    faults.add(path, "serial_burst", note, shifted)
    faults.add(path, "serial_burst_dropped", "the Arduino's clock is missing, or steps back after them", dropped)
    return sorted(placed, key=lambda c: c.system_s)


def in_order(timed: list[tuple[float, Item]], went_on: list[bool], path: Path, what: str, faults: Faults) -> list[Item]:
    """Sort the items by time; if the clock was set back, everything from there on is left out.

    timed: (time in seconds, item), in the file's order. went_on: for each item but the first, whether it was made after
    the one before it, whatever their times say.
    """
    times_s = [time_s for time_s, _ in timed]
    # Two times are later than the two that follow: one wrong time is no clock set back.
    back = (i for i in range(2, len(timed)) if went_on[i - 1] and min(times_s[i - 2 : i]) > max(times_s[i : i + 2]))
    end = next(back, len(timed))
    note = f"the clock was set back at {what} {end}; from there on, times may be those of other moments"
    faults.add(path, f"clock_set_back_at_{what}", note, len(timed) - end)
    unsorted = sum(b < a for a, b in pairwise(times_s[:end]))
    faults.add(path, f"unsorted_{what}_times", f"{what}s were put in order of time", unsorted)
    return [item for _, item in sorted(timed[:end], key=lambda pair: pair[0])]
